"""With TLS a page is a secure context of a browser that trusts the server's CA, and of no other."""

from __future__ import annotations

import base64
import hashlib
import os
import shutil
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from playwright.sync_api import Error, sync_playwright

from service.api.certificates import OwnAuthority
from tests.service.patient import be_patient
from tests.service.running import Running
from tests.web.conftest import CHROMIUM, CHROMIUM_OPTIONS


@pytest.mark.slow(parts=8)
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium; on Debian: apt-get install chromium")
def test_a_page_over_tls_is_a_secure_context(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    be_patient(monkeypatch)
    now = datetime.now(UTC)
    authority = OwnAuthority(tmp_path / "data", ["foottile.local", "127.0.0.1"], now)
    authority.certify(["foottile.local", "127.0.0.1"], now)
    authority.load()
    options = [*CHROMIUM_OPTIONS, "--host-resolver-rules=MAP foottile.local 127.0.0.1"]
    if shutil.which("certutil"):
        store = tmp_path / ".pki" / "nssdb"
        store.mkdir(parents=True)
        for words in ("-N --empty-password", f"-A -t C,, -n foottile -i {authority.ca_path}"):
            subprocess.run(["certutil", "-d", f"sql:{store}", *words.split()], check=True)
    else:
        leaf = x509.load_pem_x509_certificate((tmp_path / "data/tls/server.pem").read_bytes())
        spki = leaf.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
        digest = base64.b64encode(hashlib.sha256(spki).digest()).decode()
        options.append(f"--ignore-certificate-errors-spki-list={digest}")
    running = Running(tmp_path / "data", context=authority.context, hosts=["foottile.local"])
    running.start()
    try:
        with sync_playwright() as playwright:
            for home, args, is_trusted in (
                (tmp_path, options, True),
                (tmp_path / "other", options[: len(CHROMIUM_OPTIONS) + 1], False),
            ):
                home.mkdir(exist_ok=True)
                browser = playwright.chromium.launch(
                    executable_path=CHROMIUM, args=args, env={**os.environ, "HOME": str(home)}
                )
                page = browser.new_page()
                for host in ("127.0.0.1", "foottile.local"):
                    url = f"https://{host}:{running.port}/sessions"
                    if is_trusted:
                        page.goto(url)
                        assert page.evaluate("isSecureContext")
                    else:
                        with pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
                            page.goto(url)
                browser.close()
    finally:
        running.stop()
