"""The demonstration of tracking: the live node follows a simulated sensor through a map of unknown scale."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from csgm_ros.demo.run import ACCEPTED, FAILED, DemoError, Narrator, activate, isolate, output_folder, processes
from csgm_ros.demo.walk import Walk, walk
from csgm_ros.io.results import errors

RIGHT = 0.1, 5.0  # metres and degrees up to which a pose is right
NOTICED = 1.0  # seconds within which it must be noticed that the place is lost
FOUND = 5.0  # and found again
PATIENCE = 30.0


@dataclass(frozen=True, eq=False)
class Told:
    """What the node gave out, beside the truth.

    Attributes
    ----------
    given : (F,) bool ndarray
        Frames that got a pose.
    places : (F, 3) ndarray
        Of the sensor in the room, metres; NaN where none was given.
    metres, degrees : (F,) ndarray
        Errors.
    """

    given: np.ndarray
    places: np.ndarray
    metres: np.ndarray
    degrees: np.ndarray


def run(output: str, seed: int = 0, rate: float = 1.0) -> int:
    """Run the demonstration and return its exit code: 0 where all that was given out is right.

    Parameters
    ----------
    output : str
        Folder for the picture and the log of the node; made when missing.
    seed : int
        Of the walk and of the node.
    rate : float
        Of the walk: 1 for real time.

    Raises
    ------
    InputError, DemoError
        For a folder that cannot be made; when a process ends early, with the last lines of its log.
    """
    say, folder = Narrator(), output_folder(output)
    say('simulating a room, its photos, and a depth sensor that is carried through it (takes a while)')
    made = walk(seed)
    say(f'{len(made.stamps)} frames in {made.stamps[-1]:.0f} s, {made.blocked.sum()} of them blocked; then kidnapped')
    isolate()
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / 'walk.npz'
        np.savez(file, map=made.map_points, frames=made.frames, stamps=made.stamps, rate=rate)
        commands = {
            'node': ['csgm_ros.ros.node', '--ros-args', '-p', 'mode:=tracking', '-p', f'seed:={seed}'],
            'walker': ['csgm_ros.ros.client.walker', str(file)],
        }
        with processes(commands, folder) as pids:
            say(f'node is process {pids["node"]}, the sensor is process {pids["walker"]}')
            heard = _follow(made, made.stamps[-1] / rate, say)
    return _conclude(made, told(made, heard), folder, say)


def _follow(made: Walk, seconds: float, say: Narrator) -> list:
    """Take the node to active, wait until it has worked on all frames of a walk, and return what it gave out."""
    from csgm_ros.ros.client.connection import Client
    from csgm_ros.ros.client.poses import Listener

    with Client() as client, Listener() as listener:
        activate(client, say)
        end, before = time.monotonic() + seconds + PATIENCE, ''
        while True:
            values = client.status().values
            if values['tracking']['message'] != before:
                before = values['tracking']['message']
                say(before)
            if int(values['points']['received']) >= len(made.stamps):
                break
            if time.monotonic() > end:
                heard = f'{values["points"]["received"]} of {len(made.stamps)} frames'
                raise DemoError(f'the node has heard {heard}; does a firewall block UDP here?')
        time.sleep(1.0)  # for the last frame
        counts = client.status().values['tracking']
        numbers = ', '.join(f'{name} {counts[name]}' for name in ('frames', 'dropped', 'latency ms', 'latency 95 % ms'))
        say(f'the walk is over: {numbers}')
        return list(listener.heard)


def told(made: Walk, heard: list) -> Told:
    """Lay what was given out beside the truth."""
    from csgm_ros.ros.client.walker import BEGIN

    count = len(made.stamps)
    places, metres, degrees = np.full((count, 3), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    for stamp, place in heard:
        number = int(np.argmin(np.abs(made.stamps - (stamp / 1e9 - BEGIN))))
        truth = made.truth[number]
        places[number] = made.gauge.inverse().apply(place.translation[None])[0]
        off = errors(place, truth, np.zeros((1, 3)))  # of the sensor itself
        metres[number], degrees[number] = off['mean_displacement'] / truth.scale, off['rotation_deg']
    return Told(np.isfinite(metres), places, metres, degrees)


def complaints(made: Walk, found: Told) -> list[str]:
    """Return what of the demonstration is not as it must be, a line each."""
    if not found.given.any():
        return ['no pose was given out']
    lines = []
    wrong = found.given & ~((found.metres < RIGHT[0]) & (found.degrees < RIGHT[1]))
    if wrong.any():
        lines.append(f'{wrong.sum()} poses are wrong')
    if (found.given & made.blocked).any():
        lines.append('poses were given out of blocked frames')
    for what, begin in made.interruptions.items():
        again = made.stamps[found.given & (made.stamps >= begin)]
        if not len(again) or again[0] - begin > FOUND:
            lines.append(f'not found again within {FOUND:g} s of being {what}')
    return lines


def _conclude(made: Walk, found: Told, folder: Path, say: Narrator) -> int:
    from csgm_ros.visual.paths import draw_paths

    wrong = complaints(made, found)
    first = made.stamps[found.given][0] if found.given.any() else np.nan
    seen = ~made.blocked & (made.stamps >= first)
    caption = 'no pose was given out'
    if found.given.any():
        caption = f'{found.given.sum()} of {seen.sum()} frames since the first pose at {first:.1f} s have one'
        caption += (
            f'; error: median {100 * np.nanmedian(found.metres):.1f} cm, largest {100 * np.nanmax(found.metres):.1f} cm'
            f' and {np.nanmax(found.degrees):.1f} deg'
        )
    truth = np.array([made.gauge.inverse().apply(pose.translation[None])[0] for pose in made.truth])
    room = made.gauge.inverse().apply(made.map_points)
    draw_paths(folder / 'tracking.png', room, made.stamps, truth, found.places, made.blocked, caption)
    print(f'\n{caption}\nwritten: {folder}/tracking.png, {folder}/node.log')
    say('done')
    for line in wrong:
        print(f'csgm: {line}')
    return FAILED if wrong else ACCEPTED
