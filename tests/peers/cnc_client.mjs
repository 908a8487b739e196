// A client of the package node-opcua. Usage: node cnc_client.mjs URL; it prints what it finds as one line of JSON.
import { createRequire } from "module";

const require = createRequire(import.meta.url);
const { OPCUAClient, MessageSecurityMode, SecurityPolicy } = require("node-opcua-client");

const url = process.argv[2];
const client = OPCUAClient.create({
  securityMode: MessageSecurityMode.None,
  securityPolicy: SecurityPolicy.None,
  endpointMustExist: false,
  connectionStrategy: { maxRetry: 1, initialDelay: 100 },
});
const plain = (found) => {
  let value = found.value?.value ?? null;
  if (value?.unitId !== undefined) value = { code: value.unitId, unit: value.displayName.text };
  return { value, status: found.statusCode.name };
};

const found = await client.withSessionAsync(url, async (session) => {
  const namespaces = await session.readNamespaceArray();
  const model = namespaces.indexOf("http://opcfoundation.org/UA/CNC");
  const at = async (path) => {
    const result = await session.translateBrowsePath({
      startingNode: "i=85",
      relativePath: { elements: path.split("/").map((name) => ({
        referenceTypeId: "i=33", isInverse: false, includeSubtypes: true, targetName: { namespaceIndex: model, name } })) },
    });
    if (!result.targets?.length) throw new Error(`${path}: ${result.statusCode.toString()}`);
    return result.targets[0].targetId;
  };
  const read = async (path) => plain(await session.read({ nodeId: await at(path), attributeId: 13 }));
  const axis = await session.browse({ nodeId: await at("CncInterface/CncAxisList/X"), resultMask: 63 });
  const paths = process.argv.slice(3);
  const entries = [];
  for (const path of paths) entries.push([path, await read(path)]);
  const refused = await session.write({
    nodeId: await at("CncInterface/CncAxisList/X/PosDirect/ActPos"), attributeId: 13, value: { value: { dataType: "Double", value: 1 } } });
  return { namespaces, axis: axis.references.map((each) => each.browseName.name), values: Object.fromEntries(entries), written: refused.name };
});
console.log(JSON.stringify(found));
process.exit(0);
