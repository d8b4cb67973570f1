"""Formats of downloads."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, Field

from storage.formats.writers.registry import FORMATS

router = APIRouter(prefix="/formats", tags=["data"])


class FormatView(BaseModel):
    """Format, as in `GET .../data?format=`."""

    name: str
    title: str = Field(description="Title for people.")
    opened_by: str = Field(description="Programs that open it.")
    ending: str = Field(description="File extension, without the dot.")
    media_type: str
    options: list[str] = Field(description="Download parameters of this format.")
    takes_columns: bool = Field(description="True: columns can be selected.")
    needs_forces: bool = Field(description="True: the session needs estimates.")
    needs_sealed: bool = Field(description="True: the session has to be sealed.")
    holds_several: bool = Field(description="True: one file can have all sessions of a take.")
    frames_max: int | None = Field(description="Frame limit of a download; null: no limit.")
    missing: str | None = Field(description="Missing extra of this server; null: none.")


class FormatsView(BaseModel):
    """All formats."""

    items: list[FormatView]


@router.get("", operation_id="listFormats", summary="Formats of downloads")
def list_formats() -> FormatsView:
    """Return the formats in the order of menus."""
    formats_ = FORMATS.values()
    return FormatsView(items=[FormatView.model_validate(f, from_attributes=True) for f in formats_])
