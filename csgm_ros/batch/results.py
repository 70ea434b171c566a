"""The results of many pairs: an Apache Parquet data set that is whole whenever the run that writes it is killed.

A finished row is appended to a journal and forced to disk; from time to time the journal becomes a part of the data
set, which is written aside and renamed. A row of the journal that a crash left in both places is told by its key.

``RESULTS/part-*.parquet``   the data set: every row once; readers of Parquet leave out names with ``_`` or ``.``
``RESULTS/_journal.jsonl``   rows since the last part, one a line; a torn last line is no row
``RESULTS/_lock``            locked by the run that writes
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from csgm_ros.errors import InputError

ROWS_A_PART = 4096
Row = dict[str, Any]


def schema():
    """Return the Arrow schema of a row; null where a failed pair has no value."""
    import pyarrow as pa

    text, number, vector = pa.string(), pa.float64(), pa.list_(pa.float64(), 3)
    return pa.schema(
        [
            *((name, text) for name in ('key', 'id', 'source', 'target')),
            ('accepted', pa.bool_()),
            ('failed', pa.bool_()),  # no result: bad input, or the pair killed its worker
            ('reason', text),
            ('T_target_source', pa.list_(number, 16)),  # row by row
            *((name, number) for name in ('scale', 'fitness_source', 'fitness_target', 'inlier_rmse', 'margin')),
            ('evidence', pa.map_(text, number)),  # every number of the verdict
            ('source_center', vector),  # of the source's nodes, and their RMS distance to it: where T was measured
            ('source_spread', number),
            ('timings', pa.map_(text, number)),
            ('seconds', number),
            ('read_seconds', number),
            ('seed', pa.int64()),
            ('initial', pa.list_(number, 16)),  # where the transform was expected, null where nowhere
            ('initial_sigma', vector),
            ('profile', text),
            ('parameters', text),  # those that differ from the profile, JSON
            ('parameters_hash', text),
            ('versions', pa.map_(text, text)),
            ('worker', text),
            ('finished', text),  # ISO 8601, UTC
        ]
    )


def read(folder: str | Path) -> list[Row]:
    """Return every row of a data set and its journal, by id.

    Raises
    ------
    InputError
        For a folder that holds no results.
    """
    folder = Path(folder)
    empty = dict.fromkeys(schema().names)
    rows = {row['key']: {**empty, **row} for row in [*_journal_rows(folder), *_part_rows(folder)]}
    if not rows:
        raise InputError(f'{folder}: holds no results; run csgm batch PAIRS -o {folder} first')
    return sorted(rows.values(), key=lambda row: row['id'])


class Results:
    """The writing end, one at a time: a context manager.

    Parameters
    ----------
    folder : str or Path
        Made where it does not exist.

    Raises
    ------
    InputError
        When the folder cannot be written, or another run writes there.
    """

    _journal: int
    _length: int

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / '_lock').open('w')
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise InputError(f'{folder}: another run writes there; wait for it or choose another folder') from None
        except OSError as error:
            raise InputError(f'{folder}: cannot be written ({error.strerror}); choose another place') from None
        parts = {row['key'] for row in _part_rows(self.folder, ['key'])}
        self._recent = {row['key']: row for row in _journal_rows(self.folder) if row['key'] not in parts}
        self.keys = parts | set(self._recent)
        with self._writing():
            for torn in self.folder.glob('.part-*'):
                torn.unlink()
            self._restart_journal(self._recent.values())

    def __enter__(self) -> Results:
        return self

    def __exit__(self, *_):
        os.close(self._journal)
        self._lock.close()

    def append(self, *rows: Row) -> None:
        """Add rows, those that are there already left out; on return they are on the disk.

        Raises
        ------
        InputError
            When the disk is full; what was there before stays.
        """
        fresh = {row['key']: row for row in rows if row['key'] not in self.keys}
        with self._writing():
            try:
                _write(self._journal, b''.join(map(_line, fresh.values())))
                os.fsync(self._journal)
            except OSError:
                os.ftruncate(self._journal, self._length)  # half a row is none, and nobody was told of the others
                raise
        self._length = os.fstat(self._journal).st_size
        self._recent |= fresh
        self.keys |= set(fresh)
        if len(self._recent) >= ROWS_A_PART:
            self.commit()

    def commit(self) -> None:
        """Make the journal a part of the data set."""
        if not self._recent:
            return
        number = 1 + max((int(part.stem.split('-')[1]) for part in self.folder.glob('part-*.parquet')), default=-1)
        with self._writing():
            _write_part(self.folder / f'part-{number:06d}.parquet', list(self._recent.values()))
            self._recent = {}
            self._restart_journal(())

    def drop_failed(self) -> int:
        """Take out the rows of failed pairs, so that these are tried again; return how many."""
        self.commit()
        dropped = 0
        with self._writing():
            for part in sorted(self.folder.glob('part-*.parquet')):
                rows = _rows_of(part)
                kept = [row for row in rows if not row['failed']]
                if kept and len(kept) < len(rows):
                    _write_part(part, kept)
                elif not kept:
                    part.unlink()
                self.keys -= {row['key'] for row in rows if row['failed']}
                dropped += len(rows) - len(kept)
        return dropped

    def _restart_journal(self, rows: Iterable[Row]) -> None:
        """Put a journal of these rows in the place of the old one."""
        fresh = self.folder / '_journal.new'
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
        try:
            _write(descriptor, b''.join(map(_line, rows)))
            os.fsync(descriptor)
            os.replace(fresh, self.folder / '_journal.jsonl')
        except OSError:
            os.close(descriptor)
            raise
        if hasattr(self, '_journal'):
            os.close(self._journal)
        self._journal, self._length = descriptor, os.fstat(descriptor).st_size
        _sync_folder(self.folder)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                f'{self.folder}: cannot be written ({error.strerror}); what is done is kept: make room and run again'
            ) from None


def _part_rows(folder: Path, columns: list[str] | None = None) -> Iterator[Row]:
    for part in sorted(folder.glob('part-*.parquet')):
        yield from _rows_of(part, columns)


def _rows_of(part: Path, columns: list[str] | None = None) -> list[Row]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_table(part, columns=columns, partitioning=None).to_pylist(maps_as_pydicts='lossy')
    except (pa.ArrowException, OSError) as error:
        raise InputError(f'{part}: cannot be read ({str(error).splitlines()[0]}); remove it and run again') from None


def _journal_rows(folder: Path) -> Iterator[Row]:
    """Yield the rows of the journal up to the first torn line."""
    with contextlib.suppress(FileNotFoundError), (folder / '_journal.jsonl').open('rb') as file:
        for line in file:
            try:
                yield json.loads(line)
            except ValueError:
                return


def _line(row: Row) -> bytes:
    return json.dumps(row).encode() + b'\n'


def _write(descriptor: int, data: bytes) -> None:
    """Write all of it: a nearly full disk takes a part and raises at the next try."""
    while data:
        data = data[os.write(descriptor, data) :]


def _write_part(path: Path, rows: list[Row]) -> None:
    """Write a part aside, force it to disk and rename it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = schema()
    table = pa.Table.from_pylist([{**row, **_as_maps(row, columns)} for row in rows], columns)
    aside = path.with_name(f'.{path.name}')
    try:
        with aside.open('wb') as file:
            pq.write_table(table, file, compression='zstd')
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        aside.unlink(missing_ok=True)
        raise
    os.replace(aside, path)
    _sync_folder(path.parent)


def _as_maps(row: Row, columns) -> Row:
    """Arrow takes a map as a list of pairs."""
    import pyarrow as pa

    names = [field.name for field in columns if pa.types.is_map(field.type)]
    return {name: list(row[name].items()) for name in names if isinstance(row.get(name), dict)}


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
