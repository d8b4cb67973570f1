"""TLS contexts with trusted CAs, and explanations of TLS errors."""

from __future__ import annotations

import os
import ssl
import stat
from pathlib import Path

from foottile.errors import UsageError

_BYTES_MAX = 16 << 20
"""Size limit of a file of CAs: 70 times Debian's."""


def make_context(ca: str | os.PathLike[str] | None = None) -> ssl.SSLContext:
    """Return a context that trusts the CAs of this machine and of a file.

    The machine's CAs are OpenSSL's, or those of the variables SSL_CERT_FILE and SSL_CERT_DIR.

    Args:
        ca: certificates in PEM, or a folder prepared by `openssl rehash`.

    Raises:
        UsageError: no readable certificate.
    """
    context = ssl.create_default_context()
    if ca is None:
        return context
    path = Path(ca)
    count_before = len(context.get_ca_certs())
    try:
        if path.is_dir():
            context.load_verify_locations(capath=path)  # read on demand
            has_certs = any(each.suffix in (".pem", ".crt", ".0") for each in path.iterdir())
        else:
            _check_file(path)
            context.load_verify_locations(cafile=path)
            has_certs = len(context.get_ca_certs()) > count_before or _is_trusted(path)
    except (OSError, ValueError) as error:  # an ssl.SSLError is an OSError
        raise UsageError(
            f"{str(path)!r}: no CA certificates can be read: {error}; expected a file in PEM"
        ) from error
    if not has_certs:
        raise UsageError(f"{str(path)!r}: there is no CA certificate in it; expected a file in PEM")
    return context


def _check_file(path: Path) -> None:
    """Reject a pipe, on which OpenSSL would block, and a huge file."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode) or found.st_size > _BYTES_MAX:
        raise ValueError(f"not a file of at most {_BYTES_MAX >> 20} MiB")


def _is_trusted(path: Path) -> bool:
    """Return whether the certificates of a file are already in the machine's trust store."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(cafile=path)
    return bool(context.get_ca_certs())


def explain_tls(error: BaseException | None) -> str | None:
    """Return problem and remedy of a TLS failure; None for other errors.

    Args:
        error: exception, perhaps with a TLS error as its cause.
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
