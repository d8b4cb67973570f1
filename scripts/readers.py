"""Opens a sealed file and its export with releases of other readers, and prints what came of it.

    python scripts/readers.py FRAMES.parquet --venvs FOLDER

The table in docs/formats.md is from this. Each release has a virtual environment of its own in
FOLDER, made with uv and the Python that it has wheels for; one that cannot be had is named.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

READERS = {
    "pyarrow": "import pyarrow.parquet as p; t = p.read_table(path); n = t.num_rows",
    "fastparquet": "import fastparquet as p; n = len(p.ParquetFile(path).to_pandas())",
    "duckdb": (
        "import duckdb as p; c = p.connect(); "
        "c.execute(f\"create table t as select * from read_parquet('{path}')\"); "
        "n = c.execute('select count(*) from t').fetchone()[0]"
    ),
    "polars": "import polars as p; n = len(p.read_parquet(path))",
}
"""How each reads every value of a file."""
RELEASES = {
    "3.9": [
        *("pyarrow==6.0.0", "pyarrow==10.0.1", "pyarrow==12.0.1", "pyarrow==15.0.2"),
        *("duckdb==0.3.1", "duckdb==0.8.1", "duckdb==0.10.0", "duckdb==1.0.0"),
        *("fastparquet==0.7.2", "fastparquet==2023.4.0", "polars==0.20.0", "polars==1.0.0"),
    ],
    "3.11": [
        *("pyarrow==18.0.0", "duckdb==1.4.0", "duckdb==1.5.1", "duckdb==1.5.3", "duckdb==2.0.0"),
        *("fastparquet==2026.9.0", "polars"),
    ],
}
"""Releases by the Python that they have wheels for: the oldest is of autumn 2021."""


def make_venv(folder: Path, python: str, release: str) -> Path:
    """Make an environment with one release, unless it is there: its interpreter."""
    interpreter = folder / "bin" / "python"
    if not (folder / "whole").exists():
        subprocess.run(["uv", "venv", "--quiet", "--clear", "--python", python, folder], check=True)
        words = ["uv", "pip", "install", "--quiet", "--only-binary", ":all:", "--python"]
        older = ["numpy<2", "pandas<2.2"] if python == "3.9" else []
        subprocess.run([*words, interpreter, release, *older], check=True)
        (folder / "whole").touch()
    return interpreter


def try_to_read(interpreter: Path, reader: str, file: Path) -> str:
    """Read a file with it: "yes", or the end of what it says."""
    code = f"import sys; path = sys.argv[1]; {READERS[reader]}; print(n)"
    words = [interpreter, "-W", "ignore", "-c", code, file]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode == 0:
        return "yes"
    return "no: " + (done.stderr.strip().splitlines() or ["killed"])[-1][:90]


def main() -> None:
    """Print a row for each release."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frames", type=Path, help="sealed file")
    parser.add_argument("--venvs", type=Path, required=True)
    asked = parser.parse_args()
    asked.venvs.mkdir(exist_ok=True)
    exported = asked.venvs / "exported.parquet"
    foottile = Path(sys.executable).parent / "foottile"
    words = [foottile, "export", asked.frames, "--format", "parquet", "--out", exported]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    print("| reader | sealed | exported |\n|---|---|---|")
    for python, releases in RELEASES.items():
        for release in releases:
            try:
                interpreter = make_venv(asked.venvs / release, python, release)
            except subprocess.CalledProcessError:
                print(f"| {release} | not to be had here | |")
                continue
            reader = release.partition("==")[0]
            said = [try_to_read(interpreter, reader, each) for each in (asked.frames, exported)]
            print(f"| {release} | {' | '.join(said)} |", flush=True)


if __name__ == "__main__":
    main()
