"""Valid inputs of every kind that is read, as small as they get: what the mutations start from."""

import functools
import io
import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np

from csgm_ros.config import NodeConfig, profile
from csgm_ros.io import bags
from csgm_ros.io.config_files import config_yaml
from csgm_ros.io.files import write_cloud
from csgm_ros.types import Cloud

POINTS = np.random.default_rng(1).normal(size=(40, 3)) * (3, 2, 1) + (5, 0, 0)
COLORS = np.random.default_rng(2).integers(0, 256, (40, 3)) / 255
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
CAMERAS = {  # beside a depth image
    'camera.json': b'{"intrinsic_matrix": [500, 0, 0, 0, 400, 0, 2, 1, 1], "depth_scale": 500}',
    'camera.yaml': b'camera_matrix:\n  rows: 3\n  data: [500, 0, 2, 0, 400, 1, 0, 0, 1]\ndepth_scale: 1000\n',
    'camera.txt': b'500 0 2\n0 400 1\n0 0 1\n',
}
SHORT = POINTS[:12].astype('f4')


def ply_texts() -> list[bytes]:
    """Text and binary PLY files with lists, further elements, both byte orders and all types."""
    head = 'ply\nformat {} 1.0\ncomment made by hand\nobj_info none\n'
    rows = '\n'.join(' '.join(f'{value:.4f}' for value in row) for row in SHORT)
    plain = 'element vertex 12\nproperty float x\nproperty float y\nproperty float z\n'
    listed = 'element vertex 12\nproperty double x\nproperty list uchar int ring\nproperty short y\nproperty float z\n'
    faces = 'element face 2\nproperty list uchar int vertex_indices\n'
    camera = 'element camera 1\nproperty float view\nproperty list uint uchar name\n'
    made = [
        (head.format('ascii') + plain + 'end_header\n' + rows + '\n').encode(),
        (head.format('ascii') + plain + faces + 'end_header\n' + rows + '\n3 0 1 2\n4 0 1 2 3\n').encode(),
        (head.format('ascii') + listed + 'end_header\n' + '\n'.join(f'{i} 2 7 8 {i} 0.5' for i in range(12))).encode(),
        (head.format('ascii') + plain + 'end_header\n' + rows + '\n').replace('\n', '\r\n').encode(),
    ]
    for name, order in (('binary_little_endian', '<'), ('binary_big_endian', '>')):
        start = head.format(name)
        body = b''.join(struct.pack(order + 'dBiihf', i, 2, 1, 2, i % 7, 0.5) for i in range(12))
        made.append(
            (start + camera + listed + faces + 'end_header\n').encode()
            + (struct.pack(order + 'fI3s', 1.0, 3, b'abc') + body + 2 * struct.pack(order + 'Biii', 3, 0, 1, 2))
        )
        ushort = 'property ushort red\nproperty ushort green\nproperty ushort blue\n'
        body = b''.join(struct.pack(order + '3f3H', *row, 1, 2, 65535) for row in SHORT)
        made.append((start + plain + ushort + 'end_header\n').encode() + body)
    return made


def pcd_texts() -> list[bytes]:
    """Text, binary and compressed PCD files of several layouts."""
    head = '# .PCD\nVERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH 12\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n'
    plain = head.format('x y z', '4 4 4', 'F F F', '1 1 1')
    odd = head.format('normal_x Z _ y X rgb', '4 8 1 2 4 4', 'F F U I F U', '1 1 3 1 1 1')
    rows = '\n'.join(' '.join(f'{value:.4f}' for value in row) for row in SHORT)
    body = b''.join(struct.pack('<fd3BhfI', 0.0, row[2], 0, 0, 0, 7, row[0], 0x102030) for row in SHORT)
    planes = np.ascontiguousarray(SHORT.T, '<f4').tobytes()
    packed = b''.join(bytes([len(planes[i : i + 32]) - 1]) + planes[i : i + 32] for i in range(0, len(planes), 32))
    packed = packed[: -len(planes[128:]) - 1] + bytes([15]) + planes[128:]  # one literal run less long than 32
    return [
        (plain + 'POINTS 12\nDATA ascii\n' + rows + '\n').encode(),
        (odd + 'DATA binary\n').encode() + body,
        (plain + 'POINTS 12\nDATA binary_compressed\n').encode() + struct.pack('<II', len(packed), 144) + packed,
    ]


def text_files() -> list[bytes]:
    """Columns of text as different tools write them."""
    rows = [' '.join(f'{value:.4f}' for value in row) + f' {i} 0 255' for i, row in enumerate(SHORT)]
    return [
        '\n'.join(rows).encode(),
        ('//X Y Z R G B\n' + '\n'.join(rows)).encode(),
        ('\ufeff12\n' + '\n'.join(rows).replace(' ', ',')).encode(),
        (
            '"x";"y";"z"\r\n' + '\r\n'.join(row.rsplit(' ', 3)[0].replace('.', ',').replace(' ', ';') for row in rows)
        ).encode(),
        ('\ufeffx\ty\tz\tr\tg\tb\n' + '\n'.join(rows).replace(' ', '\t')).encode('utf-16-le'),
    ]


def depth_images() -> list[bytes]:
    """Depth images of millimetres: a ramp, and a larger one with gaps, in several chunks and with a text."""
    from PIL import Image, PngImagePlugin

    rows, columns = np.mgrid[:48, :64]
    bent = (1500 + 40 * np.abs(columns - 32) + rows % 7 + (rows * columns) % 5).astype(np.uint16)
    bent[rows % 11 == 0] = 0
    info = PngImagePlugin.PngInfo()
    info.add_text('unit', 'mm')
    return [
        _png(Image.fromarray(np.arange(48, dtype=np.uint16).reshape(6, 8) * 40)),
        _png(Image.fromarray(bent), pnginfo=info, optimize=True, dpi=(72, 72)),
    ]


def _png(image, **options) -> bytes:
    made = io.BytesIO()
    image.save(made, 'png', **options)
    return made.getvalue()


def meshes() -> dict[str, list[bytes]]:
    """Meshes of every kind: plain, coloured, in parts, with what else tools write into them, and bare points."""
    import trimesh

    box, colored = trimesh.creation.box((1, 2, 3)), trimesh.creation.box((2, 1, 1))
    colored.visual.vertex_colors = np.column_stack([np.arange(24).reshape(8, 3), np.full(8, 255)]).astype(np.uint8)
    scene = trimesh.Scene([colored])
    scene.add_geometry(box, transform=trimesh.transformations.rotation_matrix(0.5, (0, 0, 1), (1, 2, 3)))
    bare = trimesh.Scene([trimesh.PointCloud(POINTS, np.full((len(POINTS), 4), 200, np.uint8))])
    corners = '\n'.join('v {:.3f} {:.3f} {:.3f}'.format(*row) for row in SHORT)
    fine = '\n'.join('v {:.3f} {:.3f} {:.3f} 0.1 0.5 1.0'.format(*row) for row in SHORT)
    odd = (
        f'# made\nmtllib none.mtl\no one\ng a b\n{fine}\nvt 0 1\nvn 0 0 1\nusemtl m\ns 1\n'
        'f 1/1/1 2/1/1 3/1/1 4/1/1\nf -1//1 -2//1 -3//1\nl 1 2\np 3\n'
    )
    export = trimesh.exchange.export.export_mesh
    made = {kind: [export(box, None, kind)] for kind in ('stl', 'obj', 'off', 'glb')}
    made['stl'].append(export(box, None, 'stl_ascii'))
    made['obj'] += [odd, corners, odd.replace('\n', '\r\n')]
    made['off'].append(f'OFF\n# a comment\n12 2 0\n{corners.replace("v ", "")}\n3 0 1 2\n4 3 4 5 6 255 0 0\n')
    made['glb'] += [trimesh.exchange.gltf.export_glb(each) for each in (scene, bare)]
    made['gltf'] = [
        trimesh.exchange.gltf.export_gltf(each, merge_buffers=True, embed_buffers=True)['model.gltf']
        for each in (scene, bare)
    ]
    return {f'cloud.{kind}': found for kind, found in made.items()}


def colmap_models() -> list[bytes]:
    """One binary model with tracks of different lengths."""
    points = (
        struct.pack('<Q3d3BdQ', i, *row, 1, 2, 3, 0.5, i % 3) + (i % 3) * struct.pack('<II', 1, 2)
        for i, row in enumerate(SHORT)
    )
    return [struct.pack('<Q', len(SHORT)) + b''.join(points)]


def e57_files(folder: Path) -> list[bytes]:
    """Scans of every layout: floats and colours with a pose, integers with 16-bit colours and gaps, spheres."""
    import pye57

    path = folder / 'made.e57'
    names = 'cartesianX', 'cartesianY', 'cartesianZ', 'colorRed', 'colorGreen', 'colorBlue'
    columns = dict(zip(names, (*POINTS.T, *np.rint(255 * COLORS.T)), strict=True))
    with pye57.E57(str(path), 'w') as image:
        image.write_scan_raw(columns, rotation=np.array([0.6, 0.0, 0.0, 0.8]), translation=np.array([1.0, 2.0, 3.0]))
    made = [path.read_bytes()]
    with pye57.E57(str(path), 'w') as image:
        columns |= {name: np.rint(65535 * color) for name, color in zip(names[3:], COLORS.T, strict=True)}
        add_scan(image, {**columns, 'cartesianInvalidState': np.arange(len(POINTS)) % 5 == 1})
    made.append(path.read_bytes())
    reach, level = np.linalg.norm(POINTS, axis=1), np.linalg.norm(POINTS[:, :2], axis=1)
    angles = np.arctan2(POINTS[:, 1], POINTS[:, 0]), np.arctan2(POINTS[:, 2], level)
    spheres = dict(zip(('sphericalRange', 'sphericalAzimuth', 'sphericalElevation'), (reach, *angles), strict=True))
    with pye57.E57(str(path), 'w') as image:
        for columns in (spheres, spheres):
            add_scan(image, columns)
    return [*made, path.read_bytes()]


def add_scan(image, columns: dict[str, np.ndarray]) -> None:
    """Append a scan: coordinates as tenths of a millimetre, colours of 16 bits, spheres as doubles."""
    from pye57 import libe57

    file, columns = image.image_file, {name: np.array(column, float) for name, column in columns.items()}
    count = len(next(iter(columns.values())))
    scan, prototype, buffers = libe57.StructureNode(file), libe57.StructureNode(file), libe57.VectorSourceDestBuffer()
    for name, column in columns.items():  # the buffers only point to them
        if name.startswith('cartesian') and name.endswith(('X', 'Y', 'Z')):
            node = libe57.ScaledIntegerNode(file, 0, -(10**9), 10**9, 1e-4, 0.0)
        elif name.startswith('spherical'):
            node = libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE, -1e9, 1e9)
        else:
            node = libe57.IntegerNode(file, 0, 0, 65535 if name.startswith('color') else 2)
        prototype.set(name, node)
        buffers.append(libe57.SourceDestBuffer(file, name, column, count, True, True))
    if 'colorRed' in columns:
        limits = libe57.StructureNode(file)
        for name in ('colorRed', 'colorGreen', 'colorBlue'):
            limits.set(f'{name}Minimum', libe57.IntegerNode(file, 0, 0, 65535))
            limits.set(f'{name}Maximum', libe57.IntegerNode(file, 65535, 0, 65535))
        scan.set('colorLimits', limits)
    points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set('points', points)
    image.data3d.append(scan)
    writer = points.writer(buffers)
    writer.write(count)
    writer.close()


@functools.cache
def files() -> dict[str, list[bytes]]:
    """Return the seeds of each kind of file, by the name that such a file must have."""
    with tempfile.TemporaryDirectory() as folder:
        return _files(Path(folder))


def _files(folder: Path) -> dict[str, list[bytes]]:
    seeds = {
        'cloud.ply': ply_texts(),
        'cloud.pcd': pcd_texts(),
        'cloud.xyz': text_files(),
        'cloud.e57': e57_files(folder),
        'depth.png': depth_images(),
        **{name: [text] for name, text in CAMERAS.items()},
        'points3D.bin': colmap_models(),
        'points3D.txt': [b'# 3D points\n' + b''.join(b'%d 1.5 2 %d 1 2 3 0.5 1 2 3 4\n' % (i, i) for i in range(12))],
        **{f'cloud.{kind}': [] for kind in ('npy', 'npz', 'las', 'laz')},
        **meshes(),
    }
    for kind in ('ply', 'pcd', 'xyz', 'npy', 'npz', 'las', 'laz'):
        for colors, normals in ((None, None), (COLORS, NORMALS)):
            write_cloud(folder / f'seed.{kind}', POINTS, colors, normals=normals)
            seeds[f'cloud.{kind}'].append((folder / f'seed.{kind}').read_bytes())
    np.savez(folder / 'plain.npz', points=POINTS, names=np.array(['a', 'b']))
    seeds['cloud.npz'].append((folder / 'plain.npz').read_bytes())
    np.save(folder / 'frame.npy', np.asfortranarray(POINTS.reshape(4, 10, 3), 'f4'))
    seeds['cloud.npy'].append((folder / 'frame.npy').read_bytes())
    return {name: [each.encode() if isinstance(each, str) else each for each in found] for name, found in seeds.items()}


def sealed(kind: str, data: bytes) -> bytes:
    """Return a damaged file with its checksums and its length made right, so that the damage gets past them."""
    return SEALS[kind](data) if kind in SEALS else data


def _sealed_pages(data: bytes) -> bytes:
    pages = [data[at : at + 1020].ljust(1020, b'\0') for at in range(0, len(data), 1024)]
    if pages:
        pages[0] = pages[0][:16] + struct.pack('<Q', 1024 * len(pages)) + pages[0][24:]
    return b''.join(page + struct.pack('>I', _castagnoli(page)) for page in pages)


def _castagnoli(data: bytes) -> int:
    """Return the CRC-32C of E57's pages."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = CASTAGNOLI[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def _castagnoli_entry(value: int) -> int:
    for _ in range(8):
        value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
    return value


CASTAGNOLI = [_castagnoli_entry(value) for value in range(256)]


def _sealed_chunks(data: bytes) -> bytes:
    made, at = data[:8], 8
    while at + 8 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], 'big')
        made += data[at:end] + struct.pack('>I', zlib.crc32(data[at + 4 : end]))
        at = end + 4
    return made


SEALS = {'cloud.e57': _sealed_pages, 'depth.png': _sealed_chunks}


def bag(folder: Path, storage: str) -> dict[str, bytes]:
    """Return the files of a bag of one coloured source and two target clouds."""
    clouds = [
        ('/source', Cloud(POINTS, np.rint(255 * COLORS).astype(np.uint8), 'a', 10**18)),
        *(('/target', Cloud(POINTS, None, 'b', 10**18 + i)) for i in range(2)),
    ]
    bags.write_clouds(folder / storage, clouds, storage=storage)
    return {path.name: path.read_bytes() for path in sorted((folder / storage).iterdir())}


def parameter_files() -> list[bytes]:
    """The whole configuration, and the forms that a file of ROS takes."""
    return [
        config_yaml(profile(), NodeConfig()).encode(),
        b'/**:\n  ros__parameters:\n    use_sim_time: true\n    icp: {iterations: 12, gates: [0.1, 1e-2]}\n'
        b'robot:\n  csgm:\n    ros__parameters:\n      time_budget: 5\n      qos_overrides: {/source: {depth: 1}}\n',
    ]
