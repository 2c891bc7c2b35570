"""Certificates of a page: files that were given, or one made here for a phone in the same network."""

import datetime
import ipaddress
import os
import ssl
from pathlib import Path

from lerobot_cqn.errors import ConfigError

__all__ = ["Certificate", "check_certificate", "own_certificate"]

type Certificate = tuple[Path, Path]  # of the certificate and of its key, PEM

DAYS = 30


def check_certificate(certfile: str | Path, keyfile: str | Path) -> Certificate:
    """Both files; raises ConfigError where they cannot be read or do not belong together."""
    pair = Path(certfile).expanduser(), Path(keyfile).expanduser()
    for path, name in zip(pair, ("certfile", "keyfile"), strict=True):
        if not path.is_file():
            raise ConfigError(f"--page.{name}={path}: no such file; expected a PEM file.")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(*pair)
    except (ssl.SSLError, OSError) as error:
        raise ConfigError(
            f"--page.certfile={pair[0]} and --page.keyfile={pair[1]} cannot be used ({error}): expected a certificate"
            " and its key without a password, both as PEM."
        ) from error
    return pair


def own_certificate(folder: Path, hosts: list[str]) -> tuple[Certificate, str]:
    """A certificate for `hosts` (names or addresses), signed by itself, kept in `folder` for 30 days.

    Returns:
        its files, the key readable by their owner alone, and its SHA-256 fingerprint to compare in the browser.

    Raises:
        ConfigError: the package cryptography is missing.
    """
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import NameOID
    except ImportError as error:
        raise ConfigError(
            f"--page.tls needs the package {error.name}: pip install 'lerobot_policy_cqn[page]', or give"
            " --page.certfile and --page.keyfile."
        ) from error

    def named(host: str) -> x509.GeneralName:
        try:
            return x509.IPAddress(ipaddress.ip_address(host))
        except ValueError:
            return x509.DNSName(host)

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "operator's page of cqn-train")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=DAYS))
        .add_extension(x509.SubjectAlternativeName([named(host) for host in dict.fromkeys(hosts)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(parents=True, exist_ok=True)
    certfile, keyfile = folder / "certificate.pem", folder / "key.pem"
    certfile.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    with open(os.open(keyfile, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
    return (certfile, keyfile), made.fingerprint(hashes.SHA256()).hex(":").upper()
