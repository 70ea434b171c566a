"""Files that appear whole or not at all: written without a name, flushed to the disk, and only then put in place."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from csgm_ros.errors import InputError


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file that takes the place of ``path`` when the ``with`` ends well, and leaves nothing when it does not.

    Parameters
    ----------
    path : str or Path
        Where the file shall be. A symbolic link is followed; what is no regular file (a pipe, a device) is written
        directly.

    Yields
    ------
    file object
        Binary, readable and seekable; :func:`name_of` gives it a path for libraries that want one.

    Raises
    ------
    InputError
        Where the place cannot be written, or the disk is full.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            if path.is_dir():
                raise InputError(f'{path}: is a folder; name a file')
            with path.open('wb') as file:
                yield file
            return
        yield from _replaced(path.resolve())
    except OSError as error:
        why = error.strerror or ' '.join(str(error).split()) or type(error).__name__
        raise InputError(f'{path}: cannot be written ({why}); make room or choose another place') from None


def _replaced(path: Path) -> Iterator[BinaryIO]:
    file, temporary = _unnamed(path)
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if temporary is None:
                temporary = _beside(path)
                _give_name(file, temporary)
        os.replace(temporary, path)
    except BaseException:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()
        raise
    _sync_folder(path.parent)


def _unnamed(path: Path) -> tuple[BinaryIO, Path | None]:
    """Open a file of the folder that has no name, so that even a killed process leaves none; else one with a name."""
    mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(13, 'the file is write-protected')
    with suppress(OSError, AttributeError):
        if os.access('/proc/self/fd', os.X_OK):
            return os.fdopen(os.open(path.parent, os.O_TMPFILE | os.O_RDWR, mode), 'w+b'), None
    temporary = _beside(path)
    return os.fdopen(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, mode), 'w+b'), temporary


def _give_name(file: BinaryIO, path: Path) -> None:
    descriptors = os.open('/proc/self/fd', os.O_RDONLY)  # Python follows the link only relative to a folder
    try:
        os.link(str(file.fileno()), path, src_dir_fd=descriptors, follow_symlinks=True)
    finally:
        os.close(descriptors)


def _beside(path: Path) -> Path:
    return path.with_name(f'.{path.name[:100]}.{secrets.token_hex(4)}.tmp')


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _sync_folder(folder: Path) -> None:
    """Bring the new name itself to the disk, where the file system allows it."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_text(path: str | Path, text: str) -> None:
    """Write text as UTF-8, whole or not at all; see :func:`replacing`."""
    with replacing(path) as file:
        file.write(text.encode('utf-8'))


@contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """Fill a folder that appears under ``path`` when the ``with`` ends well; ``path`` must not exist.

    Raises
    ------
    InputError
        Where it exists already, or cannot be written.
    """
    path = Path(path)
    if path.exists():
        raise InputError(f'{path} exists already; name a folder that does not')
    temporary = _beside(path)
    try:
        temporary.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        for file in temporary.rglob('*'):
            with file.open('rb') as handle:
                os.fsync(handle.fileno())
        temporary.rename(path)
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror}); make room or choose another place') from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    _sync_folder(path.parent)
