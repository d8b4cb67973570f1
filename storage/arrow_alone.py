"""Arrow without pandas, which it would load in every process of ours, and which none of them uses.

Where pandas is installed, pyarrow imports it for the first array that a process makes, to know
pandas' types when it meets them: 0.45 s of CPU and 35 MB. It looks for it only once. Who calls
`to_pandas` afterwards has it imported then, as ever.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

import pyarrow as pa


class _NoPandas(MetaPathFinder):
    """Stands before all other finders, and says that there is none."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == "pandas":
            raise ModuleNotFoundError("not needed here", name=fullname)
        return None


def leave_pandas_out() -> None:
    """Have pyarrow look for pandas now, in vain; if it is loaded already, all stays as it is."""
    if "pandas" in sys.modules:
        return
    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)
