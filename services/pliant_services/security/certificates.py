"""An authority of our own and a certificate for everybody in a session: ``pliant certs``."""

import ipaddress
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any

from pliant.errors import PliantError, ResultError

_VALID = timedelta(days=825)  # the longest that common TLS libraries take
_BACKDATED = timedelta(days=1)  # machines' clocks differ


def make_certificates(folder: Path, names: Sequence[str], hosts: Sequence[str]) -> list[str]:
    """Make what is missing of the authority and the named certificates; returns what was made.

    hosts: names and addresses by which the router is reached.  Keys are readable by their owner
    alone.  Raises PliantError without the package ``cryptography``, ResultError where the folder
    cannot be written.
    """
    x509 = _module("x509")
    ec = _module("hazmat.primitives.asymmetric.ec")
    made: list[str] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "ca.key").exists():
            key = ec.generate_private_key(ec.SECP256R1())
            _write(folder, "ca", key, _sign(key, "pliant", key, "pliant", authority=True, hosts=()))
            made.append("ca")
        authority = _load_key(folder / "ca.key")
        issuer = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
        del issuer  # read, so that a broken one is noticed before keys are made for it
        for name in names:
            if (folder / f"{name}.key").exists():
                continue
            key = ec.generate_private_key(ec.SECP256R1())
            certificate = _sign(key, name, authority, "pliant", authority=False, hosts=hosts)
            _write(folder, name, key, certificate)
            made.append(name)
    except OSError as error:
        raise ResultError(f"{folder}: cannot be written: {error.strerror}") from None
    except ValueError as error:
        raise ResultError(f"{folder}: a broken authority there: {error}") from None
    return made


def _module(name: str) -> Any:
    try:
        return import_module(f"cryptography.{name}")
    except ImportError:
        raise PliantError(
            "certificates need the package cryptography: pip install pliant[tls]"
        ) from None


def _sign(
    key: Any, name: str, authority_key: Any, issuer: str, *, authority: bool, hosts: Sequence[str]
) -> Any:
    x509, hashes = _module("x509"), _module("hazmat.primitives.hashes")
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(_name(issuer))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + _VALID)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
    )
    if not authority:
        names = [_host(x509, host) for host in (name, *hosts)]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        usages = x509.oid.ExtendedKeyUsageOID
        usage = x509.ExtendedKeyUsage([usages.CLIENT_AUTH, usages.SERVER_AUTH])
        builder = builder.add_extension(usage, critical=False)
    return builder.sign(authority_key, hashes.SHA256())


def _name(common_name: str) -> Any:
    x509 = _module("x509")
    return x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, common_name)])


def _host(x509: Any, host: str) -> Any:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host.replace("_", "-"))


def _load_key(path: Path) -> Any:
    return _module("hazmat.primitives.serialization").load_pem_private_key(path.read_bytes(), None)


def _write(folder: Path, name: str, key: Any, certificate: Any) -> None:
    forms = _module("hazmat.primitives.serialization")
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(forms.Encoding.PEM))
    secret = key.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, forms.NoEncryption())
    descriptor = os.open(folder / f"{name}.key", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(secret)
