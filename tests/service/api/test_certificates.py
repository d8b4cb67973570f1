"""Certificates that a server makes: what they permit, how long they last, what is kept."""

from __future__ import annotations

import os
import ssl
import stat
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from devices.errors import DamagedFileError, UsageError
from foottile.connection import make_context, make_local_context
from service.api import certificates
from service.api.certificates import OwnAuthority, load_given_context
from service.version import SOFTWARE_DATE
from storage.permissions import set_umask_and_create_private_folder

NAMES = ["foottile.local", "laptop", "localhost", "192.168.4.1", "fe80::1%eth0", "::1"]
NOW = datetime.now(UTC)


@pytest.fixture(autouse=True)
def data(tmp_path: Path) -> Iterator[Path]:
    before = os.umask(0o022)
    set_umask_and_create_private_folder(tmp_path / "data")
    yield tmp_path / "data"
    os.umask(before)


def make(data: Path, names: list[str] = NAMES, now: datetime = NOW) -> OwnAuthority:
    authority = OwnAuthority(data, names, now)
    assert authority.certify(names, now) == []
    authority.load()
    return authority


def read_leaf(data: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((data / "tls" / "server.pem").read_bytes())


def shake_hands(server: ssl.SSLContext, client: ssl.SSLContext, name: str) -> None:
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server, server_hostname=name),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    for _ in range(4):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    assert ends[0].version() == "TLSv1.3"


def verify_strictly(data: Path, *options: str) -> subprocess.CompletedProcess[str]:
    words = ["openssl", "verify", "-x509_strict", "-purpose", "sslserver", *options]
    ca, leaf = data / "tls" / "foottile-ca.crt", data / "tls" / "server.pem"
    return subprocess.run([*words, "-CAfile", ca, leaf], capture_output=True, text=True)


def test_openssl_and_python_accept_it_strictly_for_every_name(data: Path) -> None:
    authority = make(data)
    client = make_context(authority.ca_path)
    client.verify_flags |= ssl.VERIFY_X509_STRICT
    for name in (each.partition("%")[0] for each in NAMES):
        option = "-verify_ip" if ":" in name or name[0].isdecimal() else "-verify_hostname"
        done = verify_strictly(data, option, name)
        assert done.returncode == 0, done.stderr
        shake_hands(authority.context, client, name)
    with pytest.raises(ssl.SSLCertVerificationError, match="mismatch"):
        shake_hands(authority.context, client, "192.168.4.2")
    shake_hands(authority.context, make_local_context(str(authority.ca_path)), "127.0.0.2")


@pytest.mark.parametrize(
    "name", [x509.DNSName("bank.example"), x509.DNSName("notlocal"), x509.DNSName("local.example")]
)
def test_a_thief_of_the_key_cannot_pretend_to_be_another_site(
    name: x509.DNSName, data: Path
) -> None:
    authority = make(data)
    key, _ = (data / "tls" / "server.pem").read_bytes().split(b"-----BEGIN CERT", 1)
    from cryptography.hazmat.primitives import serialization

    private = serialization.load_pem_private_key(key, None)
    forged = authority._sign(private, [name], NOW)  # type: ignore[arg-type]  # any key can be loaded
    pem = forged.public_bytes(serialization.Encoding.PEM)
    (data / "tls" / "server.pem").write_bytes(key + pem)
    authority.load()
    client = make_context(authority.ca_path)
    with pytest.raises(ssl.SSLCertVerificationError, match="permitted subtree violation"):
        shake_hands(authority.context, client, name.value)
    assert "permitted subtree violation" in verify_strictly(data).stderr


def test_the_shape_of_both_is_what_browsers_ask_for(data: Path) -> None:
    authority = make(data)
    ca, leaf = authority.certificate, read_leaf(data)
    for each in (ca, leaf):
        usage = each.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert [*usage] == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert ca.extensions.get_extension_for_class(x509.NameConstraints).critical
    basic = ca.extensions.get_extension_for_class(x509.BasicConstraints)
    assert (basic.critical, basic.value.ca, basic.value.path_length) == (True, True, 0)
    assert leaf.not_valid_after_utc - leaf.not_valid_before_utc <= timedelta(days=398)
    assert leaf.not_valid_before_utc < NOW - timedelta(days=29)  # clocks in the field are behind
    assert ca.not_valid_after_utc > NOW + timedelta(days=3650)


def test_keys_are_for_their_user_only(data: Path) -> None:
    make(data)
    files = list((data / "tls").iterdir())
    assert {path.name for path in files} == {"ca.pem", "foottile-ca.crt", "server.pem"}
    for path in (data, data / "tls", *files):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0
    assert b"PRIVATE" not in (data / "tls" / "foottile-ca.crt").read_bytes()


def test_a_restart_keeps_both_and_a_new_address_renews_the_certificate_only(data: Path) -> None:
    first = make(data)
    leaf = read_leaf(data)
    again = make(data)
    assert again.fingerprint == first.fingerprint
    assert read_leaf(data) == leaf
    assert make(data, NAMES[:2]).fingerprint == first.fingerprint
    assert read_leaf(data) == leaf  # it covers these, too
    moved = make(data, [*NAMES, "10.1.2.3"])
    assert moved.fingerprint == first.fingerprint
    assert read_leaf(data) != leaf
    shake_hands(moved.context, make_context(first.ca_path), "10.1.2.3")


def test_a_certificate_is_renewed_a_month_before_its_end(data: Path) -> None:
    authority = make(data)
    leaf = read_leaf(data)
    last = leaf.not_valid_after_utc - timedelta(days=30)
    authority.certify(NAMES, last - timedelta(seconds=1))
    assert read_leaf(data) == leaf
    authority.certify(NAMES, last)
    assert read_leaf(data).not_valid_after_utc > last + timedelta(days=300)


def test_what_is_made_in_1970_lasts_as_long_once_the_clock_is_right(data: Path) -> None:
    authority = make(data, now=datetime(1970, 1, 1, 0, 1, tzinfo=UTC))
    leaf = read_leaf(data)
    assert "1970" not in authority.certificate.subject.rfc4514_string()
    assert leaf.not_valid_before_utc <= SOFTWARE_DATE < leaf.not_valid_after_utc
    assert make(data, now=datetime(1970, 1, 1, 0, 2, tzinfo=UTC)).fingerprint == (
        authority.fingerprint
    )
    assert read_leaf(data) == leaf
    for years in (0, 1, 9):
        right = SOFTWARE_DATE + timedelta(days=365 * years)
        assert make(data, now=right).fingerprint == authority.fingerprint
        assert read_leaf(data).not_valid_before_utc <= right < read_leaf(data).not_valid_after_utc


def test_it_is_made_again_for_a_clock_that_was_set_back(data: Path) -> None:
    authority = make(data, now=NOW + timedelta(days=100))
    past = NOW
    authority.certify(NAMES, past)
    assert read_leaf(data).not_valid_before_utc < past


def test_a_name_beyond_the_constraints_is_left_out_and_explained(data: Path) -> None:
    authority = make(data)
    outside = authority.certify([*NAMES, "robot.example.org", "203.0.113.5", "schlüssel"], NOW)
    assert outside == ["robot.example.org", "203.0.113.5", "schlüssel"]
    text = authority.explain_outside(outside)
    assert "203.0.113.5" in text
    assert str(data / "tls" / "ca.pem") in text
    (data / "tls" / "ca.pem").unlink()
    make(data, [*NAMES, "robot.example.org", "203.0.113.5"])  # as the text says
    assert verify_strictly(data, "-verify_ip", "203.0.113.5").returncode == 0


@pytest.mark.parametrize("content", [b"", b"nothing", b"-----BEGIN PRIVATE KEY-----\n"])
def test_a_damaged_ca_is_never_replaced_silently(content: bytes, data: Path) -> None:
    make(data)
    (data / "tls" / "ca.pem").write_bytes(content)
    with pytest.raises(DamagedFileError, match="trust it anew"):
        OwnAuthority(data, NAMES, NOW)


def test_a_damaged_certificate_is_made_again(data: Path) -> None:
    authority = make(data)
    (data / "tls" / "server.pem").write_bytes(b"cut off")
    make(data)
    shake_hands(authority.context, make_context(authority.ca_path), "laptop")


def test_an_expired_ca_is_refused(data: Path) -> None:
    make(data)
    with pytest.raises(DamagedFileError, match=r"expired.*clock.*trust it anew"):
        OwnAuthority(data, NAMES, NOW + timedelta(days=3660))


def test_a_given_certificate_is_checked(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(data)
    good = data / "tls" / "server.pem"
    _, remarks = load_given_context(good, good)
    assert remarks == []
    for certificate, key in (
        (tmp_path / "none", good),
        (good, data / "tls" / "ca.pem"),
        (data, good),
    ):
        with pytest.raises(UsageError, match=r"--tls-cert.*--tls-key"):
            load_given_context(tmp_path / certificate, key)
    good.chmod(0o644)
    _, remarks = load_given_context(good, good)
    assert "chmod 600" in remarks[0]
    monkeypatch.setattr(certificates, "_LEAF_LIFE", timedelta(days=1))  # it began a month before
    make(tmp_path / "old")
    old = tmp_path / "old" / "tls" / "server.pem"
    with pytest.raises(UsageError, match="expired"):
        load_given_context(old, old)
