"""Settings of a server: one table of names, defaults and meanings.

A value comes from the command line, else from an environment variable `FOOTTILE_NAME`, else from
the TOML file named with --config, else from here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from platformdirs import user_data_path
from pydantic import Field, ValidationError
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from devices.errors import UsageError
from devices.inputs import TEXT_BYTES_MAX, check_file
from service.api.doors import Bounds


class Settings(Bounds, BaseSettings):
    """What a server is told; the bounds of connections are in `service.api.doors`."""

    model_config = SettingsConfigDict(env_prefix="FOOTTILE_", extra="forbid", frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0: on every one."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """TCP port; 0: any that is free."""
    data: Path = Field(default_factory=lambda: user_data_path("foottile"))
    """Folder for sessions, journals and what is known of nodes."""
    token: Annotated[str, Field(min_length=8)] | None = None
    """Asked for on every change of state; made and kept in the data folder if none is given."""
    private: bool = False
    """Is a login, or the token, asked for to look, too?"""
    allow_host: tuple[str, ...] = ()
    """Names under which the server is reached, in addition to its addresses and this machine's own
    names."""
    exact: bool = False
    """Are estimates in recorded sessions as computed, and not rounded?"""


def load_settings(config: Path | None, **given: object) -> Settings:
    """Settings from everywhere; `given` are those of the command line that are not None.

    Raises:
        UsageError: the file is not readable, a name is unknown, or a value is wrong.
    """
    if config is not None:
        try:
            check_file(config, bytes_max=TEXT_BYTES_MAX)
        except (OSError, ValueError) as error:
            raise UsageError(f"no settings file {str(config)!r}: {error}") from error

    where = "" if config is None else str(config)
    chosen = {name: value for name, value in given.items() if value is not None}
    try:
        from_file = TomlConfigSettingsSource(Settings, toml_file=config)()
        return Settings(**{**from_file, **EnvSettingsSource(Settings)(), **chosen})
    except ValidationError as error:
        complaint = error.errors()[0]
        name = ".".join(str(part) for part in complaint["loc"])
        raise UsageError(
            f"setting {name!r}: {complaint['msg']}",
            where=where,
        ) from error
    except ValueError as error:  # not TOML
        raise UsageError(f"settings are not readable: {error}", where=where) from error
