"""Secrets that a node shares with servers, by which they recognize it.

They are in the node's folder, so a renamed node counts as another node.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from devices.errors import FileFormatError, StorageError
from service.protocol.link import generate_secret
from storage.durable_files import try_set_aside_and_describe
from storage.permissions import SECRETS_NAME, read_secrets_or_empty, write_secrets

_SERVERS_MAX = 256
"""Most secrets; the oldest is dropped, as a server's address may answer with ever new ids."""


class ServerSecrets:
    """Secrets of one node, one for each server.

    Args:
        folder: the node's folder.
        report: called with errors of reading or writing, from another thread.
    """

    def __init__(self, folder: Path, report: Callable[[str], None]) -> None:
        self._path = folder / SECRETS_NAME
        self._report = report
        self._reported = ""

    def get_or_create_secret(self, server_id: str) -> str | None:
        """Return the secret for a server; create it at first contact and store it on disk.

        None: it cannot be stored. A secret lost with the process would lock the node out.
        """
        try:
            secrets = self._read()
            known = secrets.get(server_id)
            if known is None:
                known = generate_secret()
                kept = list(secrets.items())[1 - _SERVERS_MAX :]
                write_secrets(self._path, dict([*kept, (server_id, known)]))
        except StorageError as error:
            self._report_once(f"no secret is shared with the server: {error}")
            return None
        return known

    def list_server_ids(self) -> list[str]:
        """Return the ids of the servers that share a secret with the node."""
        try:
            return list(self._read())
        except StorageError:
            return []

    def _read(self) -> dict[str, str]:
        try:
            return read_secrets_or_empty(self._path)
        except FileFormatError as error:
            self._report_once(
                f"{try_set_aside_and_describe(self._path, error)}; servers that know this node "
                "refuse it until a person accepts it"
            )
            return {}

    def _report_once(self, what: str) -> None:
        if what != self._reported:
            self._report(what)
        self._reported = what
