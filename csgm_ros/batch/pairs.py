"""Which pairs a batch registers: from a table, a folder of pairs, or every two clouds of some folders."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from csgm_ros.config import Config, NodeConfig, flatten, profile
from csgm_ros.errors import CsgmError, InputError
from csgm_ros.io.config_files import assignment
from csgm_ros.io.formats import format_of
from csgm_ros.io.transforms import read_result, similarity_of
from csgm_ros.types import Prior

COLUMNS = ('source', 'target', 'id', 'seed', 'parameters', 'initial', 'initial_sigma')
NEUTRAL = ('threads',)  # parameters on which the result does not depend


@dataclass(frozen=True)
class Pair:
    """One registration of a batch: text and numbers alone, as this travels and the clouds do not.

    Attributes
    ----------
    id : str
        Name for people, unique in the batch.
    source, target : str
        Absolute paths, as the workers see them.
    profile : str
        Profile that ``changes`` are made to.
    changes : tuple of (str, value)
        Parameters that differ from the profile, dotted names in order.
    seed : int
    initial, initial_sigma : tuple of float
        Where the transform is expected, 16 numbers row by row, and how well, as :class:`csgm_ros.types.Prior` has it;
        empty where nothing is.
    """

    id: str
    source: str
    target: str
    profile: str
    changes: tuple[tuple[str, object], ...]
    seed: int
    initial: tuple[float, ...] = ()
    initial_sigma: tuple[float, ...] = ()

    @property
    def prior(self) -> Prior | None:
        """Where the transform is expected."""
        if not self.initial:
            return None
        place, angle, scale = self.initial_sigma
        return Prior(similarity_of(self.initial), (place, angle, scale))

    @property
    def parameters_hash(self) -> str:
        """What tells two configurations apart that may give two results."""
        return _hash([self.profile, [item for item in self.changes if item[0] not in NEUTRAL]])

    @property
    def key(self) -> str:
        """What tells two registrations apart: another id, file, parameter, seed or guess is another registration."""
        guess = [self.initial, self.initial_sigma] if self.initial else []
        return _hash([self.id, self.source, self.target, self.parameters_hash, self.seed, *guess])


def from_table(path: str | Path, config: Config, seed: int = 0) -> list[Pair]:
    """Read pairs from a CSV file.

    Parameters
    ----------
    path : str or Path
        With the columns `source` and `target` (relative to the file's folder), and optionally `id`, `seed`,
        `parameters` (``name=value`` items between semicolons, made to ``config``), `initial` (where the transform is
        expected: 16 numbers between blanks, row by row, or a result file, relative to the file's folder) and
        `initial_sigma` (place, degrees, relative scale between blanks).
    config : Config
    seed : int, optional
        Of pairs without one of their own.

    Raises
    ------
    InputError
        For a table that is not one, or names a pair twice; the message names the line and the remedy.
    """
    path = Path(path)
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            reader = csv.DictReader(file)
            rows, names = list(reader), reader.fieldnames or ()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f'{path}: cannot be read as CSV ({error}); check the path') from None
    unknown = [name for name in names if name not in COLUMNS]
    if unknown or not {'source', 'target'} <= set(names):
        wrong = f'unknown column {unknown[0]!r}' if unknown else 'no columns source and target'
        raise InputError(f'{path}: {wrong}; its first line names some of {",".join(COLUMNS)}')
    pairs = []
    for line, row in enumerate(rows, start=2):
        try:
            pairs.append(_from_row(row, path.parent, config, seed))
        except (CsgmError, ValueError) as error:
            raise InputError(f'{path}, line {line}: {error}') from None
    return _checked(pairs, path)


def from_folder(folder: str | Path, source: str, target: str, config: Config, seed: int = 0) -> list[Pair]:
    """Pair the files of a folder that match two globs and lie in the same subfolder.

    Raises
    ------
    InputError
        Where a subfolder holds no such file or several, or none does.
    """
    folder = Path(folder)
    found: dict[Path, dict[str, Path]] = {}
    for side, pattern in (('source', source), ('target', target)):
        for file in sorted(folder.glob(pattern)):
            known = found.setdefault(file.parent, {})
            if side in known:
                raise InputError(f'{file.parent}: {known[side].name} and {file.name} match {pattern}; narrow the glob')
            known[side] = file
    pairs = []
    for place, files in sorted(found.items()):
        if len(files) < 2:
            missing = target if 'source' in files else source
            raise InputError(f'{place}: no file matches {missing}; add it or change the glob')
        name = place.relative_to(folder).as_posix()
        pairs.append(_pair(name, files['source'], files['target'], config, seed))
    return _checked(pairs, folder)


def all_pairs(folders: Sequence[str | Path], pattern: str, config: Config, seed: int = 0) -> list[Pair]:
    """Pair every two clouds of some folders, each pair once.

    Raises
    ------
    InputError
        Where fewer than two clouds are found.
    """
    files = []
    for folder in map(Path, folders):
        files += sorted(file for file in folder.glob(pattern) if format_of(file.name))
    pairs = [
        _pair(f'{source.as_posix()}--{target.as_posix()}', source, target, config, seed)
        for target, source in itertools.combinations(files, 2)
    ]
    return _checked(pairs, ' '.join(map(str, folders)))


def _from_row(row: dict, folder: Path, config: Config, seed: int) -> Pair:
    if None in row or any(value is None for value in row.values()):
        raise InputError('has not as many values as the first line names; write it again')
    row = {name: value.strip() for name, value in row.items()}
    for side in ('source', 'target'):
        if not row[side]:
            raise InputError(f'names no {side}; fill it in')
    for item in filter(None, (item.strip() for item in row.get('parameters', '').split(';'))):
        config = assignment(config, item)
    if row.get('seed'):
        if not row['seed'].isdecimal():
            raise InputError(f'seed {row["seed"]!r} is no non-negative whole number')
        seed = int(row['seed'])
    name = row.get('id') or f'{row["source"]}--{row["target"]}'
    initial, sigma = _guess(row.get('initial', ''), row.get('initial_sigma', ''), folder)
    pair = _pair(name, folder / row['source'], folder / row['target'], config, seed)
    return replace(pair, initial=initial, initial_sigma=sigma)


def _guess(initial: str, sigma: str, folder: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return what the columns `initial` and `initial_sigma` say."""
    if not initial:
        if sigma:
            raise InputError('initial_sigma needs initial, which says what is that uncertain')
        return (), ()
    try:
        numbers = [float(word) for word in initial.split()]
    except ValueError:
        numbers = read_result(folder / initial)[0].matrix.ravel().tolist()
    else:
        try:
            similarity_of(numbers)
        except ValueError:
            raise InputError(f'initial {initial!r} is no similarity; give 16 numbers, row by row, or a file') from None
    try:
        place, angle, scale = map(float, sigma.split()) if sigma else NodeConfig().initial_sigma
    except ValueError:
        raise InputError(f'initial_sigma {sigma!r}: give place, degrees and relative scale between blanks') from None
    if not min(place, angle, scale) >= 0.0:
        raise InputError(f'initial_sigma {sigma!r}: none may be below 0')
    return tuple(numbers), (place, angle, scale)


def _pair(name: str, source: Path, target: Path, config: Config, seed: int) -> Pair:
    base = flatten(profile(config.profile))
    changes = tuple((key, value) for key, value in flatten(config).items() if value != base[key])
    return Pair(name, str(source.absolute()), str(target.absolute()), config.profile, changes, seed)


def _checked(pairs: list[Pair], where: object) -> list[Pair]:
    if not pairs:
        raise InputError(f'{where}: holds no pair; see csgm batch --help')
    twice = _repeated(pair.id for pair in pairs)
    if twice is not None:
        raise InputError(f'{where}: pair {twice} is there twice; give each an id of its own')
    return pairs


def _repeated(names: Iterable[str]) -> str | None:
    seen = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None


def _hash(parts: list) -> str:
    return hashlib.sha256(json.dumps(parts, separators=(',', ':')).encode()).hexdigest()[:16]
