"""The OPC UA server of node-opcua (npm) in a process of its own, and certificates of clients for it."""

import datetime
import shutil
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

PEERS = Path(__file__).parents[1] / "peers"
INSTALLED = (PEERS / "node_modules" / "node-opcua-server").is_dir() and shutil.which("node")
needs_node_opcua = pytest.mark.skipif(not INSTALLED, reason="needs Node.js and 'npm ci --prefix tests/peers'")


@contextmanager
def node_opcua(certificates: Path | None = None) -> Iterator[str]:
    """Run ``cnc_server.mjs``; yield its address. With a folder for certificates it accepts encrypted sessions, too."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        ["node", PEERS / "cnc_server.mjs", str(port), *([str(certificates)] if certificates else [])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdin
    assert process.stdout
    shown = []
    try:
        for line in process.stdout:
            shown.append(line)
            if line == "up\n":
                break
        else:
            raise AssertionError("".join(shown))
        yield f"opc.tcp://127.0.0.1:{port}"
    finally:
        process.stdin.close()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


def write_certificate(folder: Path, uris: Sequence[str], *, common_name: str = "lab", suffix: str = ".pem") -> str:
    """Write a certificate, signed by its own key, with these URIs, and its key; return them as in ``security``."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    now = datetime.datetime.now(datetime.UTC)
    granted = ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_cert_sign")
    refused = ("key_agreement", "crl_sign", "encipher_only", "decipher_only")
    usage = dict.fromkeys(granted, True) | dict.fromkeys(refused, False)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=30))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=False)
        .add_extension(x509.KeyUsage(**usage), critical=False)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
        )
        .add_extension(
            x509.SubjectAlternativeName(
                [x509.DNSName("localhost"), *(x509.UniformResourceIdentifier(uri) for uri in uris)]
            ),
            critical=False,
        )
        .sign(key, hashes.SHA256())
    )
    form = serialization.Encoding.PEM if suffix == ".pem" else serialization.Encoding.DER
    certificate, private = folder / f"client{suffix}", folder / f"client_key{suffix}"
    certificate.write_bytes(made.public_bytes(form))
    private.write_bytes(key.private_bytes(form, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    return f"{certificate},{private}"
