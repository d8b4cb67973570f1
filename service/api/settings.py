"""Settings of a server: names, defaults and meanings in one table.

A value comes from the command line, else from an environment variable `FOOTTILE_NAME`, else from
the TOML file named with --config, else from the default. Docstrings are the help of options.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, IPvAnyNetwork, ValidationError, field_validator

from devices.errors import UsageError
from devices.input_files import read_text
from foottile.environment import read_variable
from service.user_folders import resolve_user_folder

_Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]
_Rate = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)]
_Connections = Annotated[int, Field(ge=1, le=100_000)]
_IPV4 = 4


class LimitSettings(BaseModel):
    """Limits for unauthenticated clients, as settings."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    max_connections: _Connections = 512
    """Requests and subscribers at once, without nodes; beyond it 503, or 1013 on a websocket."""
    max_connections_per_address: _Connections = 256
    """Limit per address. A phone's hotspot is one address, and so is a reverse proxy that is
    not trusted."""
    max_nodes: _Connections = 32
    """Nodes at once."""
    max_messages_per_s: _Rate = 2.0
    """Messages and control frames of a subscriber a second, and of a minute at once; beyond it
    1008. A page sends one."""
    max_messages_per_s_per_address: _Rate = 500.0
    """Limit per address; a new subscriber counts as ten messages."""
    max_messages_per_s_in_all: _Rate = 1000.0
    """Limit of all subscribers together."""
    max_header_bytes: Annotated[int, Field(ge=4096, le=1 << 20)] = 32 << 10
    """Size limit of request line and headers; beyond it 431."""
    header_timeout_s: _Seconds = 10.0
    """Timeout of a request's headers; then 408, or the connection is closed."""
    body_timeout_s: _Seconds = 20.0
    """Timeout of a request's body, or of 256 KiB of a film's; then 408."""
    idle_timeout_s: _Seconds = 30.0
    """Timeout of an idle connection."""
    trusted_proxy: tuple[IPvAnyNetwork, ...] = ()
    """Address of a reverse proxy whose X-Forwarded-For and X-Forwarded-Proto are used
    (repeatable)."""

    @property
    def trusted_peers(self) -> list[str]:
        """Trusted proxies as peer addresses: an IPv6 socket has an IPv4 peer as ::ffff:A.B.C.D."""
        mapped = [
            f"::ffff:{proxy.network_address}/{96 + proxy.prefixlen}"
            for proxy in self.trusted_proxy
            if proxy.version == _IPV4
        ]
        return [*map(str, self.trusted_proxy), *mapped]


class Settings(LimitSettings):
    """Settings of a server."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0: all addresses."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """TCP port; 0: any free one."""
    data: Path = Field(default_factory=lambda: resolve_user_folder("data", None, "--data"))
    """Folder for sessions, journals and files of nodes."""
    token: Annotated[str, Field(pattern=r"^[!-~]{8,200}$")] | None = None
    """Token required for changes; generated and stored in the data folder if none is given."""
    private: bool = False
    """Login or token required for reading, too."""
    allow_host: tuple[str, ...] = ()
    """Further name of the server, beside its addresses and the machine's names (repeatable)."""
    advertise: str | None = None
    """Address or name shown to people, as that of a reverse proxy; else the addresses found."""
    tls: bool = False
    """Serve https, with a certificate of a CA that the server makes; phones install it once."""
    tls_cert: Path | None = None
    """Serve https with this certificate (PEM, with its chain)."""
    tls_key: Path | None = None
    """Key of --tls-cert."""
    no_quantize: bool = False
    """Store estimates of recorded sessions as computed; their noise is not rounded off."""

    @field_validator("data", mode="before")
    @classmethod
    def _refuse_empty_path(cls, given: object) -> object:
        if given == "":  # as a path it would be the working folder
            raise ValueError("it is empty; expected a folder")
        return given

    @field_validator("allow_host", "trusted_proxy", mode="before")
    @classmethod
    def _split_names(cls, given: object) -> object:
        """Split the text of a variable or a file: names with commas between, or JSON."""
        if not isinstance(given, str):
            return given
        if given.startswith("["):
            return json.loads(given)
        return tuple(name for name in given.replace(",", " ").split() if name)


def load_settings(config: Path | None, **given: object) -> Settings:
    """Load the settings from all sources; `given` are those of the command line that are not None.

    Raises:
        UsageError: the file is not readable, a name is unknown, or a value is wrong.
    """
    from_file = {} if config is None else _read_file(config)
    variables = {name: f"FOOTTILE_{name.upper()}" for name in Settings.model_fields}
    read = {name: read_variable(variable) for name, variable in variables.items()}
    from_environment = {name: value for name, value in read.items() if value is not None}
    chosen = {name: value for name, value in given.items() if value is not None}
    try:
        settings = Settings.model_validate({**from_file, **from_environment, **chosen})
    except ValidationError as error:
        complaint = error.errors()[0]
        name = ".".join(str(part) for part in complaint["loc"])
        top = str(complaint["loc"][0])
        where = "" if config is None else str(config)
        if top in chosen:
            where = ""
        elif top in from_environment:
            where = variables[top]
        raise UsageError(f"setting {name!r}: {complaint['msg']}", where=where) from error
    if settings.tls and (settings.tls_cert or settings.tls_key):
        raise UsageError("--tls makes a certificate, and --tls-cert names one: choose one of them")
    if (settings.tls_cert is None) != (settings.tls_key is None):
        raise UsageError("a certificate needs its key", expected="both --tls-cert and --tls-key")
    return settings.model_copy(
        update={"data": resolve_user_folder("data", settings.data, "--data")}
    )


def _read_file(config: Path) -> dict[str, object]:
    try:
        return tomllib.loads(read_text(config))
    except OSError as error:
        raise UsageError(f"no settings file {str(config)!r}: {error}") from error
    except ValueError as error:  # neither TOML nor UTF-8
        raise UsageError(f"settings are not readable: {error}", where=str(config)) from error
