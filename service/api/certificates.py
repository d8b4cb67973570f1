"""Certificates of a server: its own CA, made once, and the certificates that the CA signs.

A phone or a node trusts the CA once; the server's own certificate follows the machine's names and
addresses. The CA is constrained to names and addresses of local networks, so that a thief of its
key can pretend to be another machine there, and no site of the internet. Both begin a month early:
clocks in the field are behind. A clock from before this software counts as its date.
"""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from devices.errors import DamagedFileError, UsageError
from devices.input_files import read_bytes
from service.version import SOFTWARE_DATE
from storage.durable_files import (
    make_synced_folder,
    read_small_file,
    translate_storage_errors,
    write_atomically,
)

FOLDER_NAME = "tls"
CA_NAME = "foottile-ca.crt"
"""File of the CA's certificate, for others."""
_CA_KEY_NAME = "ca.pem"
"""File of the CA's key, with its certificate: one file, so that one cannot be replaced alone."""
_LEAF_NAME = "server.pem"
_PEM_BYTES_MAX = 1 << 20
_PRIVATE = 0o600
_BACKDATED = timedelta(days=30)
_CA_LIFE = timedelta(days=3652)
_LEAF_LIFE = timedelta(days=397)
"""Life of a server's certificate, with the month before; browsers accept 398 days."""
_RENEWED_BEFORE = timedelta(days=30)
_LOCAL_DOMAINS = ("local", "localhost")
_LOCAL_NETWORKS = (
    *("10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16", "172.16.0.0/12"),
    *("192.168.0.0/16", "::1/128", "fc00::/7", "fe80::/10"),
)
_Key = ec.EllipticCurvePrivateKey


class OwnAuthority:
    """CA in a server's data folder, made at the first use, and the certificate that it has signed.

    Args:
        data: data folder.
        names: names and addresses of the machine; a new CA permits them beside local ones.
        now: present time by the machine's clock.

    Raises:
        DamagedFileError: the file of the CA is damaged, or its time has ended.
        StorageError: it cannot be read or written.
    """

    def __init__(self, data: Path, names: Iterable[str], now: datetime) -> None:
        now = max(now, SOFTWARE_DATE)
        self._folder = data / FOLDER_NAME
        self._leaf_path = self._folder / _LEAF_NAME
        self.ca_path = self._folder / CA_NAME
        with translate_storage_errors(self._folder):
            make_synced_folder(self._folder)
        path = self._folder / _CA_KEY_NAME
        try:
            self._key, self.certificate = _read_pair(path)
        except FileNotFoundError:
            self._key, self.certificate = _make_ca(names, now)
            _write_pair(path, self._key, self.certificate)
        if self.certificate.not_valid_after_utc < now:
            raise DamagedFileError(
                f"the CA has expired on {self.certificate.not_valid_after_utc:%Y-%m-%d}",
                where=str(path),
                remedy=f"Is the clock of this machine right? If it is: {_NEW_CA}",
            )
        write_atomically(self.ca_path, self.certificate_pem, mode=0o644)
        found = self.certificate.extensions.get_extension_for_class(x509.NameConstraints)
        self._permitted = found.value.permitted_subtrees or ()
        self.context = _make_context()
        """TLS of the server, with its newest certificate."""

    @property
    def certificate_pem(self) -> bytes:
        """Certificate of the CA."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the CA's certificate, as phones show it."""
        return self.certificate.fingerprint(hashes.SHA256()).hex(" ").upper()

    def certify(self, names: Iterable[str], now: datetime) -> list[str]:
        """Make a certificate that covers these names, unless there is one that lasts for a month.

        Returns:
            The names that the CA may not certify, and the certificate does not cover.
        """
        now = max(now, SOFTWARE_DATE)
        wanted = {each: _to_general_name(each) for each in names}
        allowed = {n for n in wanted.values() if n is not None and _is_within(n, self._permitted)}
        try:
            _, leaf = _read_pair(self._leaf_path)
            leaf.verify_directly_issued_by(self.certificate)
            alternative = leaf.extensions.get_extension_for_class(x509.SubjectAlternativeName)
            ends = leaf.not_valid_after_utc - _RENEWED_BEFORE
            is_usable = allowed <= {*alternative.value} and leaf.not_valid_before_utc <= now < ends
        except (FileNotFoundError, DamagedFileError, InvalidSignature, ValueError):
            is_usable = False
        if not is_usable:
            key = ec.generate_private_key(ec.SECP256R1())
            _write_pair(self._leaf_path, key, self._sign(key, allowed, now))
        return [each for each, name in wanted.items() if name not in allowed]

    def explain_outside(self, names: Iterable[str]) -> str:
        """Return the consequence and the remedy of names that the CA may not certify."""
        return (
            f"the certificate does not cover {', '.join(names)}: the CA may certify only local "
            "names and those of its first start. Use another address; or remove "
            f"{str(self._folder / _CA_KEY_NAME)!r} and start again: then all phones and nodes "
            "have to trust the new CA"
        )

    def load(self) -> None:
        """Use the newest certificate for new connections."""
        self.context.load_cert_chain(self._leaf_path)

    def _sign(
        self, key: _Key, names: Iterable[x509.GeneralName], now: datetime
    ) -> x509.Certificate:
        ends = min(now - _BACKDATED + _LEAF_LIFE, self.certificate.not_valid_after_utc)
        issuer = self.certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
        identifier = x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(issuer.value)
        return (
            _make_builder("FootTile server", self.certificate.subject, key, now - _BACKDATED, ends)
            .add_extension(x509.SubjectAlternativeName(sorted(names, key=str)), critical=False)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_make_usage(digital_signature=True), critical=True)
            .add_extension(identifier, critical=False)
            .sign(self._key, hashes.SHA256())
        )


_NEW_CA = (
    "Remove this file and start again: a new CA is made, and phones and nodes have to trust it anew"
)


def load_given_context(certificate: Path, key: Path) -> tuple[ssl.SSLContext, list[str]]:
    """Return the TLS of a certificate that was given, and remarks about it.

    Raises:
        UsageError: a file is missing or not readable, the key does not fit, or the certificate has
            expired.
    """
    expected = "a PEM file of the certificate and its chain, and one of its key without a password"
    context = _make_context()
    try:
        read_bytes(key, bytes_max=_PEM_BYTES_MAX)  # the error of ssl does not name it
        content = read_bytes(certificate, bytes_max=_PEM_BYTES_MAX)
        first, *_ = x509.load_pem_x509_certificates(content)
        context.load_cert_chain(certificate, key, password=b"")
        is_open = key.stat().st_mode & 0o004
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--tls-cert {str(certificate)!r}, --tls-key {str(key)!r}: {error}", expected=expected
        ) from error
    if first.not_valid_after_utc < datetime.now(UTC):
        raise UsageError(
            f"--tls-cert {str(certificate)!r} has expired on {first.not_valid_after_utc:%Y-%m-%d}",
            remedy="Renew it. Is the clock of this machine right?",
        )
    return context, [f"everybody may read {str(key)!r}: chmod 600"] if is_open else []


def _make_context() -> ssl.SSLContext:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.options |= ssl.OP_NO_RENEGOTIATION
    return context


def _make_ca(names: Iterable[str], now: datetime) -> tuple[_Key, x509.Certificate]:
    key = ec.generate_private_key(ec.SECP256R1())
    permitted: list[x509.GeneralName] = [*map(x509.DNSName, _LOCAL_DOMAINS)]
    permitted += [x509.IPAddress(ipaddress.ip_network(each)) for each in _LOCAL_NETWORKS]
    for name in map(_to_general_name, names):
        if name is not None and not _is_within(name, permitted):
            is_address = isinstance(name, x509.IPAddress)
            network = ipaddress.ip_network(str(name.value)) if is_address else None
            permitted.append(name if network is None else x509.IPAddress(network))
    title = f"FootTile CA {now:%Y-%m-%d %H:%M}"
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, title)])
    certificate = (
        _make_builder(title, subject, key, now - _BACKDATED, now + _CA_LIFE)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_make_usage(key_cert_sign=True), critical=True)
        .add_extension(x509.NameConstraints(permitted, None), critical=True)
        .sign(key, hashes.SHA256())
    )
    return key, certificate


def _is_within(name: x509.GeneralName, permitted: Iterable[x509.GeneralName]) -> bool:
    """Return whether a name of the machine is in a permitted domain or network."""
    if isinstance(name, x509.IPAddress):
        address = ipaddress.ip_address(str(name.value))
        networks = (each.value for each in permitted if isinstance(each, x509.IPAddress))
        return any(address in ipaddress.ip_network(str(network)) for network in networks)
    domains = (each.value for each in permitted if isinstance(each, x509.DNSName))
    return any(f".{name.value}".endswith(f".{domain}") for domain in domains)


def _make_builder(
    title: str, issuer: x509.Name, key: _Key, begins: datetime, ends: datetime
) -> x509.CertificateBuilder:
    """Return the parts that a CA and its certificates share."""
    return (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, title)]))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begins)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
    )


_USAGES = (
    *("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"),
    *("key_agreement", "key_cert_sign", "crl_sign", "encipher_only", "decipher_only"),
)


def _make_usage(**used: bool) -> x509.KeyUsage:
    return x509.KeyUsage(**dict.fromkeys(_USAGES, False) | used)


def _to_general_name(name: str) -> x509.DNSName | x509.IPAddress | None:
    """Return a name or an address for a certificate; None if it can have none such."""
    try:
        return x509.IPAddress(ipaddress.ip_address(name.partition("%")[0]))
    except ValueError:
        return x509.DNSName(name.lower()) if name.isascii() and name else None


def _read_pair(path: Path) -> tuple[_Key, x509.Certificate]:
    content = read_small_file(path)
    try:
        key = serialization.load_pem_private_key(content, None)
        certificate = x509.load_pem_x509_certificate(content)
        public = certificate.public_key()
    except (ValueError, TypeError) as error:
        raise DamagedFileError(
            f"no key and certificate: {error}", where=str(path), remedy=_NEW_CA
        ) from error
    if not isinstance(key, _Key) or key.public_key() != public:
        raise DamagedFileError("its key does not fit", where=str(path), remedy=_NEW_CA)
    return key, certificate


def _write_pair(path: Path, key: _Key, certificate: x509.Certificate) -> None:
    pem = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    content = pem + certificate.public_bytes(serialization.Encoding.PEM)
    write_atomically(path, content, mode=_PRIVATE)
