"""Our own authority, and certificates for all members of a session: ``pliant certs``."""

import ipaddress
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any

from pliant.errors import PliantError, ResultError
from pliant.files import write_whole

ROUTER = "router"
ANY_SESSION = "*"
_LONGEST_NAME = 64  # of a holder, in a certificate
_AUTHORITY = "pliant"
_VALID = timedelta(days=825)  # the longest that common TLS libraries take
_BACKDATED = timedelta(days=1)  # machines' clocks differ


def common_name(name: str, session: str = ANY_SESSION) -> str:
    """The holder in the certificate; the router serves all sessions."""
    return name if session == ANY_SESSION or name == ROUTER else f"{name}.{session}"


def make_certificates(
    folder: Path,
    names: Sequence[str],
    hosts: Sequence[str],
    *,
    authority: Path | None = None,
    session: str = ANY_SESSION,
) -> list[str]:
    """Make what is missing of the authority and the named certificates; returns what was made.

    Only the one named ROUTER proves a server, with these ``hosts``, the names and addresses by
    which it is reached; the others prove clients.  authority: the folder of the authority's own
    key, beside the other unless it is given: its holder can pose as any service, so it
    is not where services look.  session: the only one in which they are good.  Keys are readable by
    their owner alone.  Raises PliantError without
    the package ``cryptography``, ResultError if a folder cannot be written or does not fit.
    """
    authority = authority or authority_of(folder)
    _check(folder, authority)
    if max(len(common_name(name, session)) for name in names) > _LONGEST_NAME:
        raise ResultError(f"--session {session}: too long a name for certificates")
    x509 = _module("x509")
    ec = _module("hazmat.primitives.asymmetric.ec")
    made: list[str] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        authority.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not (authority / "ca.key").exists():
            key = ec.generate_private_key(ec.SECP256R1())
            _write(authority, "ca", key, _sign(_authority_named(_AUTHORITY, key), key))
            made.append("ca")
        signing = _load_key(authority / "ca.key")
        issuer = (authority / "ca.pem").read_bytes()
        x509.load_pem_x509_certificate(issuer)  # a broken one is noticed before keys are made
        write_whole(folder / "ca.pem", issuer)
        for name in names:
            holder = common_name(name, session)
            if (folder / f"{name}.key").exists():
                _check_holder(folder / f"{name}.pem", holder)
                continue
            key = ec.generate_private_key(ec.SECP256R1())
            certificate = _leaf_named(holder, key, hosts if name == ROUTER else None)
            _write(folder, name, key, _sign(certificate, signing))
            made.append(name)
    except OSError as error:
        where = error.filename or folder
        raise ResultError(f"{where}: cannot be written: {error.strerror}") from None
    except ValueError as error:
        raise ResultError(f"{authority}: damaged signing key or certificate: {error}") from None
    return made


def authority_of(folder: Path) -> Path:
    """Where the key of the authority of these certificates lies, unless it was put elsewhere."""
    return folder.with_name(f"{folder.resolve().name}-authority")


def _check(folder: Path, authority: Path) -> None:
    if authority.resolve().is_relative_to(folder.resolve()):
        raise ResultError(
            f"{authority}: services read {folder}: choose an --authority outside of it"
        )
    if (folder / "ca.key").exists():
        raise ResultError(
            f"{folder}: made by an earlier release, in which every certificate could imitate the "
            "router: make new ones in another folder"
        )
    if (folder / "ca.pem").exists() and not (authority / "ca.key").exists():
        raise ResultError(
            f"{authority / 'ca.key'}: missing, but {folder} has certificates signed by it: pass "
            "its folder with --authority"
        )


def _check_holder(path: Path, holder: str) -> None:
    x509 = _module("x509")
    subject = x509.load_pem_x509_certificate(path.read_bytes()).subject
    names = [each.value for each in subject.get_attributes_for_oid(x509.oid.NameOID.COMMON_NAME)]
    if names != [holder]:
        raise ResultError(
            f"{path}: certificate of {', '.join(names)}, not of {holder}: use a separate folder "
            "for each session"
        )


def _module(name: str) -> Any:
    try:
        return import_module(f"cryptography.{name}")
    except ImportError:
        raise PliantError(
            "certificates need the package cryptography: pip install pliant[tls]"
        ) from None


def _authority_named(name: str, key: Any) -> Any:
    x509 = _module("x509")
    constraints = x509.BasicConstraints(ca=True, path_length=None)
    return _builder(name, key).add_extension(constraints, critical=True)


def _leaf_named(name: str, key: Any, hosts: Sequence[str] | None) -> Any:
    """A server's for these hosts, or with None a client's."""
    x509 = _module("x509")
    usages = x509.oid.ExtendedKeyUsageOID
    usage = usages.CLIENT_AUTH if hosts is None else usages.SERVER_AUTH
    builder = (
        _builder(name, key)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=True)
    )
    if hosts is None:
        return builder
    names = [_host(x509, host) for host in (name, *hosts)]
    return builder.add_extension(x509.SubjectAlternativeName(names), critical=False)


def _builder(name: str, key: Any) -> Any:
    x509 = _module("x509")
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(_name(_AUTHORITY))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + _VALID)
    )


def _sign(builder: Any, authority_key: Any) -> Any:
    return builder.sign(authority_key, _module("hazmat.primitives.hashes").SHA256())


def _name(common_name: str) -> Any:
    x509 = _module("x509")
    return x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, common_name)])


def _host(x509: Any, host: str) -> Any:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _load_key(path: Path) -> Any:
    return _module("hazmat.primitives.serialization").load_pem_private_key(path.read_bytes(), None)


def _write(folder: Path, name: str, key: Any, certificate: Any) -> None:
    forms = _module("hazmat.primitives.serialization")
    write_whole(folder / f"{name}.pem", certificate.public_bytes(forms.Encoding.PEM))
    secret = key.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, forms.NoEncryption())
    write_whole(folder / f"{name}.key", secret, mode=0o600)
