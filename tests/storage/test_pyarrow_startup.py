"""pyarrow looks for pandas once in a process: each of these is one of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("pandas")


def _said(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_our_arrays_do_not_load_pandas_and_it_can_be_loaded_afterwards() -> None:
    code = """
import sys
import storage.schema
import numpy, pyarrow
pyarrow.array(numpy.arange(3.0)).to_numpy()
print("pandas" in sys.modules)
frame = pyarrow.table({"grf_n": [1.0, None]}).to_pandas()
frame["t"] = ["a", "b"]
column = pyarrow.array(frame["grf_n"], from_pandas=True)
print(len(pyarrow.Table.from_pandas(frame)), column.null_count)
"""
    assert _said(code).split() == ["False", "2", "1"]


def test_pandas_that_is_there_already_stays_as_it_is() -> None:
    code = """
import pandas, pyarrow
import storage.schema
column = pyarrow.array(pandas.Series([1.0, None]), from_pandas=True)
print(column.null_count, pandas.Series.__name__)
"""
    assert _said(code) == "1 Series"
