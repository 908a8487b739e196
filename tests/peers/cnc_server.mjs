// An OPC UA server of the package node-opcua with the published information model for CNC systems (OPC 40502).
// Usage: node cnc_server.mjs PORT [FOLDER]; it prints "up", and ends when its standard input is closed. With a folder, for
// its certificates, it accepts signed and encrypted sessions, too, and trusts every certificate that is valid. Beside the
// model it has nodes for offsets: ns=1;s=Offset.X to Z (Double, mm), Heartbeat, Stop, List, and ReadOnly.
import { createRequire } from "module";

const require = createRequire(import.meta.url);
const { OPCUAServer } = require("node-opcua-server");
const { MessageSecurityMode, SecurityPolicy } = require("node-opcua-secure-channel");
const { nodesets } = require("node-opcua-nodesets");
const { DataType, VariantArrayType } = require("node-opcua-variant");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

const [port, folder] = process.argv.slice(2);
const { None, SignAndEncrypt } = MessageSecurityMode;
const { None: Open, Basic256Sha256, Aes128_Sha256_RsaOaep } = SecurityPolicy;
const certificates = folder && new OPCUACertificateManager({ rootFolder: folder, automaticallyAcceptUnknownCertificate: true });
if (certificates) await certificates.initialize();
const server = new OPCUAServer({
  port: Number(port),
  nodeset_filename: [nodesets.standard, nodesets.cnc],
  securityModes: folder ? [None, SignAndEncrypt] : [None],
  securityPolicies: folder ? [Open, Basic256Sha256, Aes128_Sha256_RsaOaep] : [Open],
  ...(folder ? { serverCertificateManager: certificates, userCertificateManager: certificates } : {}),
});
await server.initialize();
const space = server.engine.addressSpace;
const model = space.getNamespaceIndex("http://opcfoundation.org/UA/CNC");
const own = space.getOwnNamespace();
const type = (name) => space.findObjectType(name, model);
const child = (parent, name) => parent.getChildByName(name, model) ?? parent.getChildByName(name);
const set = (parent, name, dataType, value) => child(parent, name).setValueFromSource({ dataType, value });
const unit = (variable, code, text) => {
  const unitId = [...code].reduce((sum, letter) => sum * 256 + letter.charCodeAt(0), 0);
  const information = { unitId, displayName: { text }, description: { text }, namespaceUri: "http://www.opcfoundation.org/UA/units/un/cefact" };
  const old = variable.getChildByName("EngineeringUnits");
  if (old) space.deleteNode(old);
  own.addVariable({
    propertyOf: variable,
    browseName: { namespaceIndex: 0, name: "EngineeringUnits" },
    dataType: "EUInformation",
    value: { dataType: DataType.ExtensionObject, value: space.constructExtensionObject(space.findDataType("EUInformation"), information) },
  });
};

const root = type("CncInterfaceType").instantiate({ browseName: { namespaceIndex: model, name: "CncInterface" }, optionals: ["CncTypeName", "VendorRevision"], organizedBy: space.rootFolder.objects });
set(root, "VendorName", DataType.String, "node-opcua");
set(root, "CncTypeName", DataType.String, "CNC of a test");
set(root, "VendorRevision", DataType.String, "1.0");
for (const [i, name] of ["X", "Y", "Z"].entries()) {
  const axis = type("CncAxisType").instantiate({ browseName: { namespaceIndex: model, name }, componentOf: child(root, "CncAxisList") });
  const position = child(axis, "PosDirect");
  for (const [part, value] of [["ActPos", 100 + i + 0.25], ["CmdPos", 100 + i]]) {
    set(position, part, DataType.Double, value);
  }
  unit(position, "MMT", "mm"); // the model has the unit at the group, not at its members
}
const spindle = type("CncSpindleType").instantiate({ browseName: { namespaceIndex: model, name: "S1" }, componentOf: child(root, "CncSpindleList") });
set(spindle, "ActSpeed", DataType.Double, 4500);
unit(child(spindle, "ActSpeed"), "RPM", "r/min");
set(spindle, "ActLoad", DataType.Double, 12.5);
unit(child(spindle, "ActLoad"), "P1", "%");
const channel = type("CncChannelType").instantiate({ browseName: { namespaceIndex: model, name: "CH1" }, componentOf: child(root, "CncChannelList") });
set(channel, "ActFeedrate", DataType.Double, 600);
unit(child(channel, "ActFeedrate"), "H81", "mm/min");
set(channel, "ActOperationMode", DataType.Int32, 1);
set(channel, "ActProgramName", DataType.String, "TEST.NC");
set(channel, "ActProgramStatus", DataType.Int32, 1);

const node = (name, dataType, value, more = {}) => own.addVariable({
  organizedBy: space.rootFolder.objects, nodeId: `s=${name}`, browseName: name, dataType, value: { dataType, value, ...more },
  ...(name === "ReadOnly" ? { accessLevel: "CurrentRead", userAccessLevel: "CurrentRead" } : {}),
});
for (const axis of "XYZ") node(`Offset.${axis}`, "Double", 0);
node("Heartbeat", "UInt32", 7);
node("Stop", "Boolean", false);
node("ReadOnly", "Double", 0);
own.addVariable({
  organizedBy: space.rootFolder.objects, nodeId: "s=List", browseName: "List", dataType: "Double", valueRank: 1,
  value: { dataType: DataType.Double, arrayType: VariantArrayType.Array, value: new Float64Array([1, 2, 3]) },
});

await server.start();
console.log("up");
process.stdin.on("end", async () => {
  await server.shutdown(0);
  process.exit(0);
});
process.stdin.resume();
