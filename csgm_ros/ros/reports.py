"""The page that shows the last registration, on request: nothing of it is kept where no folder is set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from csgm_ros.errors import InputError
from csgm_ros.io.files import CloudFile
from csgm_ros.ros.registration import Outcome
from csgm_ros.types import Cloud
from csgm_ros.visual.report import write_report
from csgm_ros.visual.report_data import report_data


def save_report(folder: str, outcome: Outcome) -> Path:
    """Write the page of an outcome with details and return its path, named after the stamp of the later cloud.

    Raises
    ------
    InputError
        Where the folder cannot be made or the file not be written.
    """
    place = Path(folder).expanduser()
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'report_folder {place}: cannot be made ({error.strerror}); choose another') from None
    stamp = max(outcome.source.stamp, outcome.target.stamp)
    path = (place / f'report_{stamp // 10**9}_{stamp % 10**9:09d}.html').absolute()
    names = outcome.source.frame_id or 'source', outcome.target.frame_id or 'target'
    data = report_data(outcome.result, _shown(outcome.source), _shown(outcome.target), names)
    write_report(path, replace(data, facts={**data.facts, 'stamp': f'{stamp // 10**9}.{stamp % 10**9:09d}'}))
    return path


def _shown(cloud: Cloud) -> CloudFile:
    return CloudFile(cloud.points, None if cloud.colors is None else cloud.colors / 255)
