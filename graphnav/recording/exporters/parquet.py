"""Apache Parquet: the columns of trajectory.csv as doubles in full precision, a group of rows per block.

A missing value is null. Units as in trajectory.csv: degrees for angles, SI for the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic
from graphnav.recording.exporters.csv import HEADER, convert_columns


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """A Parquet file to which blocks are added; `name` is kept in its metadata.

    Raises
    ------
    RecordingError
        If pyarrow is not installed.
    """
    pa, pq = _import_pyarrow(path)
    schema = pa.schema([(column, pa.float64()) for column in HEADER.split(",")], metadata={"name": name})
    # splitting bytes by significance halves the size; a dictionary of unique doubles would only cost
    with pq.ParquetWriter(path, schema, compression="zstd", use_dictionary=False, use_byte_stream_split=True) as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            require_geodetic(block, path)
            table = np.concatenate(
                [c if c is not None else np.full((len(block), 3), np.nan) for c, _ in convert_columns(block)], 1
            )
            arrays = [pa.array(np.ascontiguousarray(x), from_pandas=True) for x in table.T]
            file.write_table(pa.Table.from_arrays(arrays, schema=schema))

        yield add


def _import_pyarrow(path: Path) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise RecordingError(
            f"{path}: needs pyarrow; pip install -e '.[parquet]' in the clone", key="package.missing"
        ) from None
    return pyarrow, pyarrow.parquet
