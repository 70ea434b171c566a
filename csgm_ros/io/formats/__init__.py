"""One file a format, registered by one line of `FORMATS`.

The module of a format has ``read(path) -> Table | CloudFile``, and ``write(file, cloud, ending)`` where it is written
too. It raises InputError without the path, which :mod:`csgm_ros.io.files` puts in front.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Format:
    """One line of the registry.

    Attributes
    ----------
    module : str
        File of this folder.
    endings : tuple of str
        Lower-case ends of the names that it reads.
    writes : bool
        Whether it is written too.
    needs : str
        Extra of the package whose libraries it imports; empty for none.
    """

    module: str
    endings: tuple[str, ...]
    writes: bool = False
    needs: str = ''


# a longer ending wins over a shorter one
FORMATS = (
    Format('ply', ('.ply',), writes=True),
    Format('pcd', ('.pcd',), writes=True),
    Format('text', ('.xyz', '.txt', '.csv', '.asc', '.pts', '.xyzrgb', '.xyzn'), writes=True),
    Format('arrays', ('.npy', '.npz'), writes=True),
    Format('las', ('.las', '.laz'), writes=True, needs='formats'),
    Format('e57', ('.e57',), needs='formats'),
    Format('colmap', ('points3d.bin', 'points3d.txt')),
    Format('mesh', ('.obj', '.stl', '.glb', '.gltf', '.off'), needs='formats'),
    Format('depth', ('.png',)),
)
READ = tuple(ending for each in FORMATS for ending in each.endings)
WRITTEN = tuple(ending for each in FORMATS if each.writes for ending in each.endings)


def format_of(name: str) -> Format | None:
    """Return the format of a file by its name; None for an unknown ending."""
    fitting = [(len(end), each) for each in FORMATS for end in each.endings if name.lower().endswith(end)]
    return max(fitting, key=lambda pair: pair[0])[1] if fitting else None
