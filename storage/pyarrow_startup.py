"""Start of pyarrow without pandas, which no process of ours uses.

Where pandas is installed, pyarrow imports it when a process makes its first array, to recognise
pandas types: 0.45 s of CPU and 35 MB. It tries only once. A later call of `to_pandas` still imports
pandas.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

import pyarrow as pa


class _PandasBlocker(MetaPathFinder):
    """Import finder, before all others, that reports pandas as missing."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == "pandas":
            raise ModuleNotFoundError("not needed here", name=fullname)
        return None


def skip_pyarrow_pandas_import() -> None:
    """Make pyarrow's one attempt to import pandas fail; no effect if pandas is loaded already."""
    if "pandas" in sys.modules:
        return
    finder = _PandasBlocker()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)
