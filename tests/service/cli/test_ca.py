"""Commands that ask a server take the CA of its certificate, and say what else answers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.cli.outcome import Run
from tests.service.running import ServeWith
from tests.service.strangers import answer_of, portal, tls_before

TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test
COMMANDS = (
    (("sessions",), ""),
    (("invite",), ""),
    (("stream", "nobody"), "nobody"),
    (("pull", "20200101T000000Z-000000", "--out", "."), "20200101T000000Z-000000"),
)


@pytest.mark.parametrize(("words", "unknown"), COMMANDS)
def test_a_ca_is_named_with_an_option(
    serve_with: ServeWith,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    unknown: str,
) -> None:
    monkeypatch.setenv("FOOTTILE_TOKEN", TOKEN)
    with tls_before(serve_with(token=TOKEN).port, tmp_path / "tls") as url:
        refused = run(*words, "--server", url)
        assert refused.code == 1
        assert "--ca" in refused.err
        trusted = run(*words, "--server", url, "--ca", tmp_path / "tls" / "ca.pem")
    assert unknown in trusted.err
    assert "certificate" not in trusted.err
    assert (trusted.code == 0) is not bool(unknown), trusted.err


def test_a_node_refuses_a_wrong_ca_before_anything_else(run: Run) -> None:
    words = ("node", "--scene", "standing", "--server", "https://127.0.0.1:1")
    done = run(*words, "--ca", "no-such-file.pem")
    assert done.code == 2
    assert "no-such-file.pem" in done.err
    done = run("node", "--scene", "standing", "--ca", "no-such-file.pem")
    assert done.code == 2
    assert "https://" in done.err


@pytest.mark.parametrize(("words", "_unknown"), COMMANDS)
def test_a_login_page_is_an_error_of_one_line(
    run: Run, words: tuple[str, ...], _unknown: str
) -> None:
    with portal(answer_of("302 Found", "Location: http://portal.example/login")) as url:
        done = run(*words, "--server", url)
    assert done.code == 1
    assert len(done.err.splitlines()) == 1
    assert "portal.example/login" in done.err
