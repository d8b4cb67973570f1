"""Options of a node, and the secrets that it shares with servers.

They are in the node's folder, so a renamed node counts as another node. Each server has a separate
secret.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devices.errors import FileFormatError, StorageError
from service.estimation.calibration import Calibration
from service.node_identity import generate_secret
from service.rig.emulated_foot import RigOptions
from storage.durable_files import try_set_aside_and_describe
from storage.permissions import SECRETS_NAME, read_secrets_or_empty, write_secrets


@dataclass(frozen=True)
class NodeOptions:
    """Options of a node.

    Attributes:
        rig_options: options of the rig.
        node_folder: the node's folder.
        server_url: address of the server; None: no server, local recording only.
        session_name: name of a session to record on the node itself; None: no recording.
        calibration: calibration of the tiles, for the server's estimates.
        calibration_problem: reason why there is no calibration.
        token: the server's token; None: the token of this user's server on this machine.
        ca_path: file or folder of CA certificates, in addition to the system's.
    """

    rig_options: RigOptions
    node_folder: Path
    server_url: str | None
    session_name: str | None = None
    calibration: Calibration | None = None
    calibration_problem: str | None = None
    token: str | None = None
    ca_path: Path | None = None


_SERVERS_MAX = 256
"""Most secrets; the oldest is dropped, as a server's address may answer with ever new ids."""


class ServerSecrets:
    """Secrets of one node.

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
