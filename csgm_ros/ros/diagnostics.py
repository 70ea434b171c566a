"""What the node says of itself on /diagnostics: state, progress, verdict, and how the inputs do."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

if TYPE_CHECKING:
    from csgm_ros.ros.inputs import CloudInput
    from csgm_ros.ros.registration import Registration

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def diagnostics(node, inputs: list[CloudInput], registration: Registration) -> DiagnosticArray:
    """Return one status for the registration and one for each input."""
    message = DiagnosticArray()
    message.header.stamp = node.get_clock().now().to_msg()
    name = node.get_fully_qualified_name()[1:].replace('/', '.')
    message.status = [registration_status(f'{name}: registration', node.state, registration)]
    message.status += [input_status(f'{name}: {cloud_input.name}', node, cloud_input) for cloud_input in inputs]
    return message


def registration_status(name: str, state: str, registration: Registration) -> DiagnosticStatus:
    """Return state, progress of the running job, and the last outcome."""
    record, job = registration.record, registration.job
    values = {'state': state, 'accepted': record.accepted, 'rejected': record.rejected, 'failed': record.failed}
    values |= record.last
    if job is not None:
        text = f'registering: {job.stage}, {100 * job.fraction:.0f} %, {job.seconds:.1f} s'
        values |= {'stage': job.stage, 'progress': f'{job.fraction:.2f}', 'running seconds': f'{job.seconds:.2f}'}
        return status(name, OK, text, values)
    return status(name, record.level, record.text, values)


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
