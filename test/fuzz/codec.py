"""Coverage-guided fuzzing of the readers in memory (needs atheris; `pip install csgm_ros[fuzz]`).

python -m fuzz.codec pointcloud2 -max_total_time=600        (in test/; or a kind of file, such as cloud.ply)
"""

import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import atheris

with atheris.instrument_imports(include=['csgm_ros.io', 'trimesh.exchange']):
    import trimesh.exchange.load  # noqa: F401

    from csgm_ros.io import files, pointcloud2
    from csgm_ros.io.formats import arrays, colmap, depth, las, mesh, pcd, ply, text  # noqa: F401 - to be instrumented

from csgm_ros.errors import InputError
from fuzz import corpus


def message(data: bytes) -> SimpleNamespace:
    """Return a message of arbitrary layout whose points are what is left of the data."""
    take = atheris.FuzzedDataProvider(data)
    fields = [
        SimpleNamespace(
            name=take.PickValueInList(['x', 'y', 'z', 'rgb', 'rgba', 'r', 'g', 'b', '']),
            offset=take.ConsumeIntInRange(0, 40) if take.ConsumeBool() else take.ConsumeUInt(4),
            datatype=take.ConsumeIntInRange(0, 10),
            count=take.ConsumeIntInRange(0, 3),
        )
        for _ in range(take.ConsumeIntInRange(0, 8))
    ]
    sizes = [take.ConsumeIntInRange(0, 40) if take.ConsumeBool() else take.ConsumeUInt(4) for _ in range(4)]
    stamp = SimpleNamespace(sec=take.ConsumeInt(4), nanosec=take.ConsumeUInt(4))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id='', stamp=stamp),
        fields=fields,
        **dict(zip(('height', 'width', 'point_step', 'row_step'), sizes, strict=True)),
        is_bigendian=take.ConsumeBool(),
        is_dense=take.ConsumeBool(),
        data=take.ConsumeBytes(4096),
    )


def decode(data: bytes) -> None:
    """Decode one message; anything but a cloud of its size or an InputError is a finding."""
    made = message(data)
    try:
        cloud = pointcloud2.decode(made)
    except InputError:
        return
    assert cloud.points.shape[1] == 3
    assert len(cloud.points) + cloud.dropped == made.width * made.height


def read(path: Path):
    """Return what reads one file of the data."""

    if path.name == 'depth.png':
        path.with_name('camera.json').write_bytes(corpus.CAMERAS['camera.json'])

    def one(data: bytes) -> None:
        path.write_bytes(data)
        try:
            cloud = files.read_cloud(path)
        except InputError as error:
            if '\n' in str(error):
                raise
            return
        assert cloud.points.shape[1] == 3

    return one


if __name__ == '__main__':
    kind = sys.argv.pop(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'seeds').mkdir()
        if kind != 'pointcloud2':
            for number, data in enumerate(corpus.files()[kind]):
                (folder / 'seeds' / str(number)).write_bytes(data)
        atheris.Setup([*sys.argv, str(folder / 'seeds')], decode if kind == 'pointcloud2' else read(folder / kind))
        atheris.Fuzz()
