"""With TLS a page is a secure context of a browser that trusts the server's CA, and of no other."""

from __future__ import annotations

import base64
import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from playwright.sync_api import Error, Playwright

from service.api.certificates import OwnAuthority
from tests.service.patient import be_patient
from tests.service.running import Running
from tests.web.conftest import CHROMIUM, CHROMIUM_OPTIONS
from tests.web.firefox import FIREFOX, Firefox


@pytest.fixture
def secure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[OwnAuthority, int]]:
    """A server with TLS: its CA and its port."""
    be_patient(monkeypatch)
    now, names = datetime.now(UTC), ["foottile.local", "127.0.0.1"]
    authority = OwnAuthority(tmp_path / "data", names, now)
    authority.certify(names, now)
    authority.load()
    running = Running(tmp_path / "data", context=authority.context, hosts=["foottile.local"])
    running.start()
    yield authority, running.port
    running.stop()


@pytest.mark.slow(parts=8)
def test_a_page_over_tls_is_a_secure_context(
    secure: tuple[OwnAuthority, int], playwright: Playwright, tmp_path: Path
) -> None:
    authority, port = secure
    options = [*CHROMIUM_OPTIONS, "--host-resolver-rules=MAP foottile.local 127.0.0.1"]
    trusting = list(options)
    if shutil.which("certutil"):
        store = tmp_path / ".pki" / "nssdb"
        store.mkdir(parents=True)
        for words in ("-N --empty-password", f"-A -t C,, -n foottile -i {authority.ca_path}"):
            subprocess.run(["certutil", "-d", f"sql:{store}", *words.split()], check=True)
    else:
        leaf = x509.load_pem_x509_certificate((tmp_path / "data/tls/server.pem").read_bytes())
        spki = leaf.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
        digest = base64.b64encode(hashlib.sha256(spki).digest()).decode()
        trusting.append(f"--ignore-certificate-errors-spki-list={digest}")
    (tmp_path / "other").mkdir()
    for home, args in ((tmp_path, trusting), (tmp_path / "other", options)):
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=args, env={**os.environ, "HOME": str(home)}
        )
        page = browser.new_page()
        for host in ("127.0.0.1", "foottile.local"):
            url = f"https://{host}:{port}/sessions"
            if args is trusting:
                page.goto(url)
                assert page.evaluate("isSecureContext")
            else:
                with pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
                    page.goto(url)
        browser.close()


@pytest.mark.slow(parts=8)
@pytest.mark.skipif(FIREFOX is None, reason="no Firefox; on Debian: apt-get install firefox-esr")
def test_firefox_accepts_the_certificate_by_name_and_address(
    secure: tuple[OwnAuthority, int], tmp_path: Path
) -> None:
    authority, port = secure
    (tmp_path / "firefox").mkdir()
    trust = """
    const store = Cc["@mozilla.org/security/x509certdb;1"].getService(Ci.nsIX509CertDB);
    store.addCertFromBase64(arguments[0], "C,,");
    Services.prefs.setStringPref("network.dns.localDomains", "foottile.local");
    """
    der = base64.b64encode(authority.certificate.public_bytes(Encoding.DER)).decode()
    with closing(Firefox(tmp_path / "firefox")) as firefox:
        with pytest.raises(Exception, match="InsecureCertificate"):
            firefox.open(f"https://127.0.0.1:{port}/sessions")
        with firefox._driver.using_context("chrome"):
            firefox._driver.execute_script(trust, script_args=[der])
        for host in ("127.0.0.1", "foottile.local"):
            firefox.open(f"https://{host}:{port}/sessions")
            assert firefox._driver.execute_script("return isSecureContext")
