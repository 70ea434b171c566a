"""What the node says of itself on /diagnostics: state, progress, verdict, and how the inputs do."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

if TYPE_CHECKING:
    from csgm_ros.ros.inputs import CloudInput
    from csgm_ros.ros.registration import Registration
    from csgm_ros.ros.tracker import Tracker

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def diagnostics(node, mode) -> DiagnosticArray:
    """Return one status for what the mode does and one for each input."""
    message = DiagnosticArray()
    message.header.stamp = node.get_clock().now().to_msg()
    name = node.get_fully_qualified_name()[1:].replace('/', '.')
    message.status = [mode.status(name)]
    message.status += [input_status(f'{name}: {cloud_input.name}', node, cloud_input) for cloud_input in mode.inputs]
    return message


def registration_status(name: str, state: str, registration: Registration) -> DiagnosticStatus:
    """Return state, progress of the running job, and the last outcome."""
    record, job = registration.record, registration.job
    values = {'state': state, 'accepted': record.accepted, 'rejected': record.rejected, 'failed': record.failed}
    values |= record.last
    if job is not None:
        left = job.seconds_left
        soon = f', about {left:.0f} s left' if left < math.inf else ''
        text = f'registering: {job.stage}, {100 * job.fraction:.0f} %, {job.seconds:.1f} s{soon}'
        values |= {'stage': job.stage, 'progress': f'{job.fraction:.2f}', 'running seconds': f'{job.seconds:.2f}'}
        values['seconds left'] = f'{left:.1f}' if left < math.inf else 'unknown'
        return status(name, OK, text, values)
    return status(name, record.level, record.text, values)


def tracking_status(name: str, state: str, tracker: Tracker) -> DiagnosticStatus:
    """Return where the sensor is believed to be, on what evidence, and how fast that is said."""
    record, (rate, median, late) = tracker.record, tracker.pace
    values: dict[str, Any] = {'lifecycle': state, 'map frame': tracker.map_frame or 'none yet'}
    values |= {'frames': record.frames, 'dropped': record.dropped, 'failed': record.failed}
    values |= {'rate Hz': f'{rate:.1f}', 'latency ms': f'{1e3 * median:.0f}', 'latency 95 % ms': f'{1e3 * late:.0f}'}
    last = record.last
    if last is None:
        text = record.complaint or (f'waits for {"frames" if tracker.map_frame else "a map"}')
        return status(name, ERROR if record.complaint else OK, text, {'state': 'lost', **values})
    values |= {'state': last.state, 'reason': last.reason, 'work ms': f'{1e3 * last.seconds:.0f}'}
    values |= {'evidence on map': f'{last.on_map:.3f}', 'evidence agreement': f'{last.agreement:.3f}'}
    values |= {'scale': f'{last.scale:.6g}', 'scale sigma': f'{last.scale_sigma:.2g}'}
    if record.complaint:
        return status(name, WARN, f'frame left out: {record.complaint}', values)
    level = OK if last.state == 'tracking' else WARN
    return status(name, level, f'{last.state}: {last.reason}', values)


def input_status(name: str, node, cloud_input: CloudInput) -> DiagnosticStatus:
    """Return counts, age and QoS of one input, and the remedy where it is silent."""
    last = cloud_input.last_received
    values = {
        'topic': cloud_input.topic,
        'received': cloud_input.received,
        'rejected': cloud_input.rejected,
        'last error': cloud_input.last_error,
        'qos': ', '.join(cloud_input.profiles),
        'longest delay ms': f'{1000 * cloud_input.delay:.1f}',
        'seconds since last': 'never' if last is None else f'{time.monotonic() - last:.1f}',
    }
    if not cloud_input.profiles:
        return status(name, OK, f'not listening while {node.state}', values)
    if cloud_input.problem:
        return status(name, WARN, cloud_input.problem, values)
    if cloud_input.last_error and cloud_input.received == cloud_input.rejected:
        return status(name, ERROR, f'every message is unusable: {cloud_input.last_error}', values)
    return status(name, OK, f'{cloud_input.received} clouds received', values)


def status(name: str, level: bytes, text: str, values: dict) -> DiagnosticStatus:
    """Return one DiagnosticStatus."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(name=name, level=level, message=text, hardware_id='csgm', values=pairs)
