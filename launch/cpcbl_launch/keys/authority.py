"""A certificate authority and what it signs: X.509 with keys on the curve P-256, as PEM.

Raises DependencyError where `cryptography` is not installed.
"""

import ipaddress
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from typing import NamedTuple

from cpcbl_agents.extras import install_command
from cpcbl_team.errors import DependencyError, InputError
from cpcbl_transport.security import CERTIFICATE, SecurityError

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    needed = f"keys needs cryptography: {install_command('security')}"
    raise DependencyError(needed) from error

CLOCKS_APART = timedelta(days=1)  # a machine whose clock is late takes a new certificate too
AUTHORITY_DAYS = 3650
OTHER_USAGES = (
    *("content_commitment", "key_encipherment", "data_encipherment", "key_agreement"),
    *("encipher_only", "decipher_only"),
)


class KeyPair(NamedTuple):
    """A private key and its certificate, in PEM."""

    private_key: bytes
    certificate: bytes


class CertificateFacts(NamedTuple):
    """What a certificate says."""

    common_name: str
    not_after: datetime
    hosts: tuple[str, ...]


def new_authority(team: str, now: datetime) -> KeyPair:
    """An authority that signs the certificates of members, and no other authority's."""
    key = ec.generate_private_key(ec.SECP256R1())
    # Two authorities of a team have two names: a verifier looks for the signer by its name.
    name = _name(f"{team} authority {secrets.token_hex(4)}")
    until = now + timedelta(days=AUTHORITY_DAYS)
    builder = _certificate_builder(name, name, key.public_key(), now, until, is_authority=True)
    of_key = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    return _pem(key, builder.add_extension(of_key, critical=False).sign(key, hashes.SHA256()))


def issue_certificate(
    authority: KeyPair, common_name: str, hosts: Iterable[str], now: datetime, lasting: timedelta
) -> KeyPair:
    """A certificate with a new key. With hosts its owner may be dialled there, else only dial.

    Raises InputError for hosts that are none, and for an authority that ends sooner.
    """
    with _convert_read_errors("ca/private.key"):
        signer = serialization.load_pem_private_key(authority.private_key, None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    above, until = x509.load_pem_x509_certificate(authority.certificate), now + lasting
    if until > above.not_valid_after_utc:
        raise InputError(
            f"--days: the authority ends {above.not_valid_after_utc:%Y-%m-%d}; ask for fewer days,"
            " or make a new one with --renew ca"
        )
    key = ec.generate_private_key(ec.SECP256R1())
    of_signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    usages, names = [ExtendedKeyUsageOID.CLIENT_AUTH], [_host(host) for host in hosts]
    builder = _certificate_builder(
        _name(common_name), above.subject, key.public_key(), now, until, is_authority=False
    ).add_extension(of_signer, critical=False)
    if names:
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    return _pem(key, builder.sign(signer, hashes.SHA256()))


def certificate_facts(certificate: bytes) -> CertificateFacts:
    """What a certificate says. Raises SecurityError for one that cannot be read."""
    with _convert_read_errors(CERTIFICATE):
        read = x509.load_pem_x509_certificate(certificate)
    try:
        names = read.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = tuple(str(name.value) for name in names)
    except x509.ExtensionNotFound:
        hosts = ()
    common_name = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
    return CertificateFacts(str(common_name), read.not_valid_after_utc, hosts)


def is_signed_by(certificate: bytes, authority: bytes) -> bool:
    """Whether an authority signed a certificate."""
    signer = x509.load_pem_x509_certificate(authority)
    try:
        x509.load_pem_x509_certificate(certificate).verify_directly_issued_by(signer)
    except Exception:
        return False
    return True


def is_matching_pair(pair: KeyPair) -> bool:
    """Whether a private key is that of a certificate."""
    try:
        key = serialization.load_pem_private_key(pair.private_key, None)
        certificate = x509.load_pem_x509_certificate(pair.certificate)
    except ValueError:
        return False
    return key.public_key() == certificate.public_key()


def newest_certificate(bundle: bytes) -> bytes:
    """The first certificate of several in one text: that of the authority in use.

    Raises SecurityError for a text that holds none.
    """
    with _convert_read_errors("ca/ca.crt"):
        first, *_ = x509.load_pem_x509_certificates(bundle)
    return first.public_bytes(serialization.Encoding.PEM)


@contextmanager
def _convert_read_errors(file: str) -> Iterator[None]:
    """Raises SecurityError where the text of a file of keys cannot be read."""
    try:
        yield
    except ValueError as error:
        raise SecurityError(f"{file}: cannot be read: {error}; bring back a good copy") from error


def _certificate_builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    now: datetime,
    until: datetime,
    *,
    is_authority: bool,
) -> x509.CertificateBuilder:
    path_length = 0 if is_authority else None
    usage = x509.KeyUsage(
        digital_signature=not is_authority,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        **dict.fromkeys(OTHER_USAGES, False),
    )
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS_APART)
        .not_valid_after(until)
        .add_extension(x509.BasicConstraints(is_authority, path_length), critical=True)
        .add_extension(usage, critical=True)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise InputError(f"--host {host!r}: neither an address nor a name in ASCII") from error


def _pem(key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> KeyPair:
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    private_key = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain)
    return KeyPair(private_key, certificate.public_bytes(pem))
