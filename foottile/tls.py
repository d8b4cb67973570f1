"""Whose certificates are trusted, and what is wrong with one that is not."""

from __future__ import annotations

import os
import ssl
import stat
from pathlib import Path

from foottile.errors import UsageError

_BYTES_MAX = 16 << 20
"""Of a file of CAs: 70 times as many as Debian trusts."""


def make_context(ca: str | os.PathLike[str] | None = None) -> ssl.SSLContext:
    """Return a context that trusts the CAs of this machine, and those of a file.

    The machine's are those of OpenSSL, or of the variables SSL_CERT_FILE and SSL_CERT_DIR.

    Args:
        ca: certificates in PEM, or a folder of them as `openssl rehash` leaves it.

    Raises:
        UsageError: there are no certificates in it.
    """
    context = ssl.create_default_context()
    if ca is None:
        return context
    path = Path(ca)
    before = len(context.get_ca_certs())
    try:
        if path.is_dir():
            context.load_verify_locations(capath=path)  # they are read when one is needed
            has_some = any(each.suffix in (".pem", ".crt", ".0") for each in path.iterdir())
        else:
            _check_file(path)
            context.load_verify_locations(cafile=path)
            has_some = len(context.get_ca_certs()) > before or _is_known(path)
    except (OSError, ValueError) as error:  # an ssl.SSLError is an OSError
        raise UsageError(
            f"{str(path)!r}: no CA certificates can be read: {error}; expected a file in PEM"
        ) from error
    if not has_some:
        raise UsageError(f"{str(path)!r}: there is no CA certificate in it; expected a file in PEM")
    return context


def _check_file(path: Path) -> None:
    """Refuse what OpenSSL would wait for, as a pipe, or read for hours."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode) or found.st_size > _BYTES_MAX:
        raise ValueError(f"it is no file of at most {_BYTES_MAX >> 20} MiB")


def _is_known(path: Path) -> bool:
    """Return whether a file has certificates that the machine trusts without it, too."""
    alone = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    alone.load_verify_locations(cafile=path)
    return bool(alone.get_ca_certs())


def explain_tls(error: BaseException | None) -> str | None:
    """Return what is wrong with TLS and what to do; None if that is not what failed.

    Args:
        error: perhaps caused by another one.
    """
    while error is not None and not isinstance(error, ssl.SSLError):
        error = error.__cause__ or error.__context__
    if error is None:
        return None
    if isinstance(error, ssl.SSLCertVerificationError):
        remedy = "Name the file of its CA: --ca, `ca=` in Python, or SSL_CERT_FILE"
        if "valid" in error.verify_message or "expired" in error.verify_message:
            remedy = "Is the clock of this machine right?"
        elif "mismatch" in error.verify_message:
            remedy = "Use a name that the certificate has"
        return f"its certificate is not trusted: {error.verify_message}. {remedy}"
    return f"TLS failed: {error.reason or error}. If it speaks plain HTTP, use http://"
