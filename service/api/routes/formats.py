"""The formats that sessions are given away in."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, Field

from storage.formats.written.registry import FORMATS

router = APIRouter(prefix="/formats", tags=["data"])


class FormatView(BaseModel):
    """A format, as `GET .../data?format=` takes it."""

    name: str
    title: str = Field(description="For people.")
    opened_by: str = Field(description="Some programs that open it.")
    ending: str = Field(description="Of its files' names, without the dot.")
    media_type: str
    options: list[str] = Field(description="Parameters of the download that are for this format.")
    takes_columns: bool = Field(description="Can columns be chosen?")
    needs_forces: bool = Field(description="Not of a session without estimates.")
    needs_sealed: bool = Field(description="Not of a session that is not sealed.")
    holds_several: bool = Field(description="Can all sessions of a take be in one file?")
    frames_max: int | None = Field(description="Ask for a slice of more; null: any number.")
    missing: str | None = Field(description="What this server lacks for it; null: nothing.")


class FormatsView(BaseModel):
    """All formats."""

    items: list[FormatView]


@router.get("", operation_id="listFormats", summary="Formats of downloads")
def formats() -> FormatsView:
    """In the order in which menus have them."""
    known = FORMATS.values()
    return FormatsView(items=[FormatView.model_validate(f, from_attributes=True) for f in known])
