"""Clouds in rosbag2 bags (mcap or sqlite3), read and written without ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from csgm_ros.cloud.merge import merge
from csgm_ros.config import NodeConfig
from csgm_ros.errors import InputError
from csgm_ros.io.atomic import replacing_folder
from csgm_ros.io.pointcloud2 import check_layout, decode, encode
from csgm_ros.types import Cloud

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

METADATA = 'metadata.yaml'
STORED = ('.mcap', '.db3')
LAST_STAMP = 2**31 * 10**9  # nanoseconds that ROS's 32 bits of seconds can say
ROS1 = b'#ROSBAG V'
CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'


def read_clouds(
    bag: str | Path,
    source_topic: str,
    target_topic: str,
    *,
    source_window: int = 1,
    target_window: int = 1,
    window_voxel: float = NodeConfig.window_voxel,
) -> tuple[Cloud, Cloud]:
    """Return what the node would register once the whole bag has been played: the newest usable source and target.

    Parameters
    ----------
    bag : str or Path
        See :func:`open_bag`.
    source_topic, target_topic : str
        Topics as recorded.
    source_window, target_window : int
        Newest messages that are merged into one cloud.
    window_voxel : float
        See :func:`csgm_ros.cloud.merge.merge`.

    Raises
    ------
    InputError
        No such bag or topic, or no usable cloud on it; the message lists the cloud topics there are.
    """
    windows: dict[str, deque] = {source_topic: deque(maxlen=source_window), target_topic: deque(maxlen=target_window)}
    with open_bag(bag) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in windows]
        require_topics(bag, reader, windows)
        for connection, message in reader.decoded(chosen):
            if is_usable(message):
                windows[connection.topic].append(message)
    empty = [topic for topic, messages in windows.items() if not messages]
    if empty:
        raise InputError(f'{bag}: no usable cloud on {empty[0]}')
    source, target = (
        merge([decode(message) for message in windows[topic]], window_voxel) for topic in (source_topic, target_topic)
    )
    return source, target


def read_pair(bag: str | Path, source_topic: str, target_topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the (N, 3) source and (M, 3) target points of :func:`read_clouds`."""
    source, target = read_clouds(bag, source_topic, target_topic)
    return source.points, target.points


def write_clouds(
    bag: str | Path, clouds: Iterable[tuple[str, Cloud]], *, latched: Collection[str] = (), storage: str = 'mcap'
) -> None:
    """Write (topic, cloud) pairs, each at its stamp.

    Parameters
    ----------
    bag : str or Path
        Folder to make; must not exist.
    clouds : iterable of (str, Cloud)
        ``points`` may be organised, (H, W, 3) with NaN for no return.
    latched : collection of str
        Topics recorded as transient local, as an SfM map is published.
    storage : {'mcap', 'sqlite3'}

    Raises
    ------
    InputError
        When the folder exists already.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin, store = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}[storage], typestore()
    connections = {}
    with replacing_folder(bag) as folder, Writer(folder, version=9, storage_plugin=plugin) as writer:
        for topic, cloud in clouds:
            if topic not in connections:
                offered = [quality(latched=topic in latched)]
                connections[topic] = writer.add_connection(
                    topic, CLOUD_TYPE, typestore=store, offered_qos_profiles=offered
                )
            raw = store.serialize_cdr(message_of(cloud, store), CLOUD_TYPE)
            writer.write(connections[topic], cloud.stamp, raw)


class Bag:
    """An open bag whose every fault is one InputError that names it; see :func:`open_bag`."""

    def __init__(self, path: Path, reader: Reader):
        self._path, self._reader = path, reader

    @property
    def connections(self) -> list:
        """What was recorded: topic, type and QoS."""
        with _faults_of(self._path):
            return self._reader.connections

    @property
    def start_time(self) -> int:
        """Stamp of the first message, nanoseconds."""
        return self._reader.start_time

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return self._reader.message_count

    def messages(self, connections: Collection = ()) -> Iterator[tuple]:
        """Yield (connection, stamp, bytes) of the chosen connections, of all by default, as they were recorded."""
        with _faults_of(self._path):
            found = iter(self._reader.messages(connections))
        while True:
            with _faults_of(self._path):
                message = next(found, None)
            if message is None:
                return
            if not 0 <= message[1] < LAST_STAMP:
                raise InputError(f'{self._path}: holds the stamp {message[1]}, which is none of ROS; it is damaged')
            yield message

    def decoded(self, connections: Collection = ()) -> Iterator[tuple]:
        """Yield (connection, message) of :meth:`messages`."""
        store = typestore()
        for connection, _, raw in self.messages(connections):
            with _faults_of(self._path):
                message = store.deserialize_cdr(raw, connection.msgtype)
            yield connection, message


@contextmanager
def open_bag(bag: str | Path) -> Iterator[Bag]:
    """Open a bag with ``rosbags`` for the length of a ``with``.

    Parameters
    ----------
    bag : str or Path
        Folder with a metadata.yaml, that file, or one .mcap or .db3 file, which is read alone.

    Raises
    ------
    InputError
        When it is no bag, or a damaged one.
    """
    from rosbags.rosbag2 import Reader

    path = _storage(Path(bag))
    with _faults_of(path):
        reader = Reader(path)
        reader.open()
    try:
        yield Bag(path, reader)
    finally:
        with suppress(Exception):  # a damaged bag may fail to close, too
            reader.close()


def _storage(path: Path) -> Path:
    """Return what is to be opened, or say why that cannot be done."""
    if not path.exists():
        raise InputError(f'{path}: no such file or folder; name a rosbag2 folder, or an .mcap or .db3 file')
    if path.is_dir():
        if (path / METADATA).is_file():
            return path
        files = sorted(each for each in path.iterdir() if each.suffix in STORED)
        if len(files) == 1:
            return files[0]
        there = f'{len(files)} files of a bag, but' if files else ''
        raise InputError(
            f'{path}: holds {there} no {METADATA}, so it is no rosbag2 folder; try ros2 bag reindex {path}'
        )
    if path.name == METADATA:
        return path.parent
    with path.open('rb') as file:
        if file.read(len(ROS1)) == ROS1:
            raise InputError(f'{path}: is a ROS 1 bag; convert it: rosbags-convert --src {path} --dst FOLDER')
    if path.suffix not in STORED:
        raise InputError(f'{path}: is no rosbag2 folder, .mcap or .db3 file; name one')
    return path


@contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """Turn whatever a damaged bag raises into one line that names it."""
    try:
        yield
    except InputError:
        raise
    except MemoryError:
        raise InputError(f'{path}: asks for more memory than there is; the bag is damaged or too large') from None
    except Exception as error:
        why = ' '.join(f'{type(error).__name__}: {error}'.split())[:160]
        raise InputError(f'{path}: is no rosbag2 bag that can be read, or a damaged one ({why})') from None


def require_topics(bag: str | Path, reader, topics: Iterable[str]) -> None:
    """Raise InputError unless every topic is a cloud topic of the bag."""
    clouds = [connection.topic for connection in reader.connections if connection.msgtype == CLOUD_TYPE]
    for topic in topics:
        if topic not in clouds:
            there = ', '.join(sorted(set(clouds))) or 'none'
            raise InputError(f'{bag} holds no {CLOUD_TYPE} on {topic}; clouds are on: {there}')


def is_usable(message) -> bool:
    """Return True for a message that the node would keep."""
    try:
        check_layout(message)
    except InputError:
        return False
    return True


def message_of(cloud: Cloud, store):
    """Return a cloud as the typestore's PointCloud2."""
    parts = encode(cloud.points, cloud.colors)
    types = store.types
    stamp = types['builtin_interfaces/msg/Time'](cloud.stamp // 10**9, cloud.stamp % 10**9)
    field = types['sensor_msgs/msg/PointField']
    fields = [field(name, offset, code, 1) for name, offset, code in parts.pop('fields')]
    return types[CLOUD_TYPE](header=types['std_msgs/msg/Header'](stamp, cloud.frame_id), fields=fields, **parts)


def quality(*, latched: bool):
    """Return the QoS that a topic is recorded with: reliable, and latched or not."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 5,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=QosTime(0, 0),
        lifespan=QosTime(0, 0),
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=QosTime(0, 0),
        avoid_ros_namespace_conventions=False,
    )


def typestore():
    """Return the message types of Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)
