"""A window that shows a result: Rerun's where it is installed, else Open3D's."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from csgm_ros.errors import InputError
from csgm_ros.io.cloud_file import CloudFile
from csgm_ros.io.results import SOURCE_TINT, TARGET_TINT
from csgm_ros.types import Similarity
from csgm_ros.visual.pictures import finite, shades, turned, upright
from csgm_ros.visual.slices import frame_of

KEYS = 'B before and after, S source, T target, C their own colours, H all other keys, Q quit'
BEFORE, AFTER = 0, 1
POINT_SIZE = 2.0
ZOOM = 0.6  # Open3D's own leaves a third of the window empty on every side


@dataclass(frozen=True, eq=False)
class Views:
    """What a window shows: middle 0 and radius 1 for the target, as windows draw in single precision.

    Attributes
    ----------
    sources : (CloudFile, CloudFile)
        The source before, its middle and size matched with the target's, and after.
    target : CloudFile
    sides : (3, 3) ndarray
        Rows: what is right, down and away from the eye at first.
    """

    sources: tuple[CloudFile, CloudFile]
    target: CloudFile
    sides: np.ndarray


def views(source: CloudFile, target: CloudFile, transform: Similarity) -> Views:
    """Return a pair under a transform as it is shown; points that are not finite are left out."""
    source, target = finite(source), finite(target)
    frame = frame_of(target.points)
    poses = frame_of(source.points), frame @ transform
    before, after = (CloudFile(pose.apply(source.points), source.colors) for pose in poses)
    return Views(
        (before, after), CloudFile(frame.apply(target.points), target.colors), turned(upright(target.points), 28, 22)
    )


def view(
    source: CloudFile, target: CloudFile, transform: Similarity, title: str, on_frame: Callable | None = None
) -> None:
    """Open a window and return when it is closed; Rerun's stays open and is not waited for.

    Parameters
    ----------
    source, target : CloudFile
    transform : Similarity
        From source to target.
    title : str
    on_frame : callable, optional
        Called with Open3D's visualizer after each frame; which it closes by returning False. With it Open3D draws, off
        screen where there is no display.

    Raises
    ------
    InputError
        Where there is no display, or Open3D opens no window on it.
    """
    shown = views(source, target, transform)
    if on_frame is None:
        if not has_display():
            raise InputError('there is no display to open a window on; csgm register --report writes a page instead')
        if find_spec('rerun'):
            return _in_rerun(shown, title)
    return _in_open3d(shown, title, on_frame)


def has_display() -> bool:
    """Tell whether a window can be opened, so far as it can be known without trying."""
    return sys.platform != 'linux' or any(os.environ.get(name) for name in ('DISPLAY', 'WAYLAND_DISPLAY'))


def log(recording, shown: Views) -> None:
    """Log to a recording of Rerun: what is before at step 0 of its time line, and after at step 1."""
    import rerun

    recording.log('target', _logged(rerun, shown.target, TARGET_TINT), static=True)
    for step, source in enumerate(shown.sources):
        recording.set_time('step', sequence=step)
        recording.log('source', _logged(rerun, source, SOURCE_TINT))
        if source.colors is not None:
            recording.log('source_in_its_colours', rerun.Points3D(source.points, colors=source.colors))
    if shown.target.colors is not None:
        own = rerun.Points3D(shown.target.points, colors=shown.target.colors)
        recording.log('target_in_its_colours', own, static=True)


def _logged(rerun, cloud: CloudFile, tint: tuple[float, float, float]):
    return rerun.Points3D(cloud.points, colors=[tint])


def _in_rerun(shown: Views, title: str) -> None:
    import rerun

    recording = rerun.RecordingStream('csgm_ros')
    recording.spawn()
    recording.send_recording_name(title)
    log(recording, shown)
    recording.flush()
    print(f'{title}: in the window of Rerun; its time line goes from before to after')


def _in_open3d(shown: Views, title: str, on_frame: Callable | None) -> None:
    import open3d

    window = open3d.visualization.VisualizerWithKeyCallback()
    if not window.create_window(title, 1280, 800):
        raise InputError('Open3D opens no window on this display; csgm register --report writes a page instead')
    options = {'pose': AFTER, 'own': False, 'S': True, 'T': True}
    drawn = {'S': open3d.geometry.PointCloud(), 'T': open3d.geometry.PointCloud()}

    def refresh() -> bool:
        for key, cloud, tint in (('S', shown.sources[options['pose']], SOURCE_TINT), ('T', shown.target, TARGET_TINT)):
            count = len(cloud.points) if options[key] else 0
            own = cloud.colors if options['own'] and cloud.colors is not None else shades(cloud, tint)
            drawn[key].points = open3d.utility.Vector3dVector(cloud.points[:count])
            drawn[key].colors = open3d.utility.Vector3dVector(own[:count])
            window.update_geometry(drawn[key])
        return True

    def switch(name: str):
        def switched(_) -> bool:
            options[name] = BEFORE + AFTER - options['pose'] if name == 'pose' else not options[name]
            return refresh()

        return switched

    refresh()
    for cloud in drawn.values():
        window.add_geometry(cloud)
    window.get_render_option().point_size = POINT_SIZE
    control = window.get_view_control()
    control.set_front(-shown.sides[2])
    control.set_up(-shown.sides[1])
    control.set_zoom(ZOOM)
    for key, name in (('B', 'pose'), ('S', 'S'), ('T', 'T'), ('C', 'own')):
        window.register_key_callback(ord(key), switch(name))
    if on_frame is None:
        print(f'{title}: {KEYS}', flush=True)
    try:
        while window.poll_events():
            window.update_renderer()
            if on_frame is not None and not on_frame(window):
                break
    finally:
        window.destroy_window()
