"""Credentials and certificates of an OPC UA client.

The application URI that a client states must be that in its certificate (OPC 10000-4, service CreateSession): it
is read from the certificate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from errormotion.errors import InstrumentError

if TYPE_CHECKING:
    from asyncua.client.client import Client
    from cryptography.x509 import Certificate

POLICIES = ("Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss")
MODES = ("Sign", "SignAndEncrypt")
HINTS = {
    "BadCertificateUriInvalid": "the certificate of the client must state a URI as subjectAltName (URI:urn:...)",
    "BadCertificateUntrusted": "add the certificate of the client to those that the server trusts",
    "BadSecurityChecksFailed": "the server may not trust the certificate of the client, or the certificate has expired",
    "BadCertificateTimeInvalid": "the certificate has expired or is not yet valid; compare the clocks",
    "BadIdentityTokenRejected": "the server accepts neither this user nor an anonymous one; see 'user'",
    "BadIdentityTokenInvalid": "the server accepts no such user; see 'user' and 'password_file'",
    "BadUserAccessDenied": "see 'user' and 'password_file'",
}
"""Remedies by the status of a refusal."""


@dataclass(frozen=True)
class Credentials:
    """Credentials of a client; all empty: anonymous and unencrypted.

    Attributes
    ----------
    security : str
        ``Policy,Mode,certificate,private key[,server certificate]``, such as
        ``Basic256Sha256,SignAndEncrypt,client.der,client.pem``.
    user, password : str
    """

    security: str = ""
    user: str = ""
    password: str = ""

    @classmethod
    def read(cls, security: str, user: str, password_file: str) -> Credentials:
        """Return credentials with the password in the first line of a file; an empty name: none.

        Raises
        ------
        InstrumentError
            The file does not exist, or has no line of text.
        """
        if not password_file:
            return cls(security, user)
        try:
            password = Path(password_file).read_text(encoding="utf-8").splitlines()[0]
        except (OSError, IndexError, UnicodeDecodeError) as error:
            raise InstrumentError(
                f"password_file '{password_file}': expected a file with the password; {error}",
                code="opc.password.unreadable",
            ) from None
        return cls(security, user, password)


async def secure(client: Client, security: str) -> None:
    """Prepare a client for signed or encrypted messages; its application URI becomes that of the certificate.

    Parameters
    ----------
    client : asyncua.Client
        Not yet connected.
    security : str
        See `Credentials`.

    Raises
    ------
    InstrumentError
        The text has another form, a file is missing or invalid, or the server has no endpoint of this kind.
    """
    from asyncua.ua.uaerrors import UaError, UaStatusCodeError

    parts = [part.strip() for part in security.split(",")]
    if len(parts) not in (4, 5) or parts[0] not in POLICIES or parts[1] not in MODES:
        raise InstrumentError(
            f"'security': expected POLICY,MODE,CERTIFICATE,KEY[,SERVER CERTIFICATE] with the policy "
            f"{', '.join(POLICIES)} and the mode {' or '.join(MODES)}; found '{security}'",
            code="opc.security.form",
        )
    certificate = await _certificate(parts[2])
    await _check_key(parts[3])
    if parts[4:]:
        await _certificate(parts[4])
    client.application_uri = application_uri(certificate) or client.application_uri
    try:
        await client.set_security_string(",".join(parts))
    except UaStatusCodeError:
        raise
    except UaError as error:
        raise InstrumentError(
            f"'security': the server has no endpoint with policy {parts[0]} and mode {parts[1]}: {error}",
            code="opc.security.no_endpoint",
        ) from None


def application_uri(certificate: Certificate) -> str:
    """Return the first URI of the alternative names of a certificate; empty if it states none."""
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (x509.ExtensionNotFound, ValueError):  # none, or unreadable extensions
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


def hint(code: int) -> str:
    """Return the remedy for a refusal by its status code, to be added to a message; empty if none is known."""
    from asyncua.ua import StatusCode, UInt32

    known = HINTS.get(StatusCode(UInt32(code)).name)
    return f"; {known}" if known else ""


async def _certificate(path: str) -> Certificate:
    from asyncua.crypto import uacrypto

    try:
        found: Certificate = await uacrypto.load_certificate(path)
    except (OSError, ValueError) as error:
        raise InstrumentError(
            f"'security': expected a certificate (.pem or .der) in '{path}': {error}", code="opc.security.certificate"
        ) from None
    return found


async def _check_key(text: str) -> None:
    from asyncua.crypto import uacrypto

    path, _, password = text.partition("::")
    try:
        await uacrypto.load_private_key(path, password or None)
    except (OSError, ValueError, TypeError) as error:  # TypeError: with a password that is not needed, or without one
        raise InstrumentError(
            f"'security': expected a private key (.pem or .der) in '{path}': {error}", code="opc.security.key"
        ) from None
