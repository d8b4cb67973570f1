"""What stands between a client and its server: TLS of a laboratory's own CA, and portals."""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import select
import socket
import socketserver
import ssl
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from tests.waiting import PATIENCE_S

Answers = Callable[[socket.socket, threading.Event], None]


@contextlib.contextmanager
def listening(answers: Answers) -> Iterator[int]:
    """Serve each connection in a thread of its own; the port."""
    ended = threading.Event()

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.settimeout(PATIENCE_S)
            with contextlib.suppress(OSError):  # an ssl.SSLError is one
                answers(self.request, ended)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), name="stranger")
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            ended.set()
            server.shutdown()
            thread.join(PATIENCE_S)


@contextlib.contextmanager
def portal(answer: bytes, asked: list[bytes] | None = None) -> Iterator[str]:
    """Answer everything with the same bytes, as the login page of a network does; the address."""

    def answers(connection: socket.socket, _: threading.Event) -> None:
        head = b""
        while b"\r\n\r\n" not in head:
            piece = connection.recv(65536)
            if not piece:
                return
            head += piece
        if asked is not None:
            asked.append(head)
        connection.sendall(answer)

    with listening(answers) as port:
        yield f"http://127.0.0.1:{port}"


def answer_of(status: str, *headers: str, body: str = "") -> bytes:
    """An HTTP answer as bytes."""
    lines = (f"HTTP/1.1 {status}", *headers, f"Content-Length: {len(body)}", "Connection: close")
    return ("\r\n".join(lines) + "\r\n\r\n" + body).encode()


@contextlib.contextmanager
def tls_before(port: int, folder: Path) -> Iterator[str]:
    """TLS in front of a server, of a CA whose certificate is `ca.pem` in a folder; the address."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(_certificates(folder))

    def answers(connection: socket.socket, ended: threading.Event) -> None:
        with (
            context.wrap_socket(connection, server_side=True) as secure,
            socket.create_connection(("127.0.0.1", port), PATIENCE_S) as plain,
        ):
            while not ended.is_set():
                for ready in select.select([secure, plain], [], [], 0.02)[0]:
                    piece = ready.recv(1 << 16)
                    while ready is secure and secure.pending():
                        piece += secure.recv(1 << 16)
                    if not piece:
                        return
                    (plain if ready is secure else secure).sendall(piece)

    with listening(answers) as own:
        yield f"https://127.0.0.1:{own}"


def _certificates(folder: Path) -> Path:
    """A CA in `ca.pem`, and a certificate of it with its key for this machine; the path of both."""
    folder.mkdir(parents=True, exist_ok=True)
    ca_key, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    ca_name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "a laboratory")])
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "its server")])
    now = datetime.datetime.now(datetime.UTC)

    def certificate(
        subject: x509.Name, public: ec.EllipticCurvePublicKey
    ) -> x509.CertificateBuilder:
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(ca_name)
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
        )

    identifier = x509.SubjectKeyIdentifier.from_public_key(ca_key.public_key())
    authority = x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier)
    usage = dict.fromkeys(
        (
            *("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"),
            *("key_agreement", "encipher_only", "decipher_only"),
        ),
        False,
    )
    ca = (
        certificate(ca_name, ca_key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **usage), critical=True)
        .add_extension(identifier, critical=False)
        .sign(ca_key, hashes.SHA256())
    )
    addresses = [x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    own = (
        certificate(name, key.public_key())
        .add_extension(x509.SubjectAlternativeName(addresses), critical=False)
        .add_extension(authority, critical=False)
        .sign(ca_key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    (folder / "ca.pem").write_bytes(ca.public_bytes(pem))
    both = folder / "server.pem"
    both.write_bytes(
        own.public_bytes(pem)
        + key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return both
