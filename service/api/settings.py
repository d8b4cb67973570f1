"""Settings of a server: one table of names, defaults and meanings.

A value comes from the command line, else from an environment variable `FOOTTILE_NAME`, else from
the TOML file named with --config, else from here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from platformdirs import user_data_path
from pydantic import Field, ValidationError
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from devices.errors import UsageError


class Settings(BaseSettings):
    """What a server is told."""

    model_config = SettingsConfigDict(env_prefix="FOOTTILE_", extra="forbid", frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0: on every one."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """TCP port; 0: any that is free."""
    data: Path = Field(default_factory=lambda: user_data_path("foottile"))
    """Folder for sessions, journals and what is known of nodes."""
    token: Annotated[str, Field(min_length=8)] | None = None
    """Asked for on every change of state; made and kept in the data folder if the host is not
    loopback and none is given."""
    allow_host: tuple[str, ...] = ()
    """Names under which the server is reached, beside its addresses."""


def load_settings(config: Path | None, **given: object) -> Settings:
    """Settings from everywhere; `given` are those of the command line that are not None.

    Raises:
        UsageError: the file is not readable, a name is unknown, or a value is wrong.
    """
    if config is not None and not config.is_file():
        raise UsageError(f"no settings file {str(config)!r}")

    class _FromFile(Settings):
        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,
            file_secret_settings: PydanticBaseSettingsSource,
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return (
                init_settings,
                env_settings,
                TomlConfigSettingsSource(settings_cls, toml_file=config),
            )

    chosen: dict[str, Any] = {name: v for name, v in given.items() if v is not None}
    try:
        return Settings.model_construct(**_FromFile(**chosen).model_dump())
    except ValidationError as error:
        complaint = error.errors()[0]
        name = ".".join(str(part) for part in complaint["loc"])
        raise UsageError(
            f"setting {name!r}: {complaint['msg']}",
            where=str(config) if config is not None else "",
        ) from error
    except ValueError as error:  # not TOML
        raise UsageError(f"settings are not readable: {error}", where=str(config)) from error
