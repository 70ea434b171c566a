"""Talk to a running node by its services: ``csgm call``, for machines without the ``ros2`` command."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable

from rclpy.utilities import remove_ros_args

from csgm_ros.ros.client.connection import DISCOVERY, NODE, Answer, Client, NoAnswerError, Status

__all__ = ['Answer', 'Client', 'NoAnswerError', 'Status', 'call', 'main', 'status']

COMMANDS = {
    'configure': 'check the parameters and compile the kernels',
    'activate': 'listen to the clouds',
    'deactivate': 'rest, and cancel a running registration',
    'cleanup': 'back to unconfigured',
    'shutdown': 'finalize the node',
    'register': 'register the newest pair and wait for the verdict',
    'cancel': 'cancel the running registration',
    'save_report': 'write the page of the last registration into report_folder',
    'relocalize': 'let a node that tracks search for its place again',
    'status': 'state, verdict and how the inputs do',
}
FAILED, NO_ANSWER = 1, 2


def call(command: str, node: str = NODE, timeout: float | None = None) -> Answer:
    """Do one command of :data:`COMMANDS` but ``status``, over a connection of its own.

    Raises
    ------
    NoAnswerError
        When there is no such node, or it does not answer in time.
    """
    with Client(node, timeout) as client:
        return getattr(client, command)()


def _command(name: str) -> Callable[..., Answer]:
    def command(node: str = NODE, timeout: float | None = None) -> Answer:
        return call(name, node, timeout)

    command.__name__ = command.__qualname__ = name
    command.__doc__ = f'Ask the node: {COMMANDS[name]}.'
    return command


configure, activate, deactivate, cleanup, shutdown, register, cancel, save_report, relocalize = map(
    _command, list(COMMANDS)[:-1]
)


def status(node: str = NODE, timeout: float | None = None) -> Status:
    """Return state and diagnostics of a node."""
    with Client(node, timeout) as client:
        return client.status()


def space(namespace: str) -> str:
    """Return a namespace with a slash before it, empty for the root."""
    return '/' + namespace.strip('/') if namespace.strip('/') else ''


def seconds(text: str) -> float:
    """Read a number of seconds above 0."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text} is not a number of seconds above 0')
    return value


def status_text(found: Status) -> str:
    """Return a status for people, one fact a line."""
    lines = [f'state: {found.state}', found.message]
    for part, values in found.values.items():
        lines += [f'{part}:'] + [f'  {name}: {value}' for name, value in values.items() if value and name != 'state']
    return '\n'.join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run ``csgm call``; return 0, 1 where the node says no, 2 where it does not answer."""
    parser = argparse.ArgumentParser(prog='csgm call', description='Call the live node.')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument('--node', default=NODE, help='name of the node, with its namespace; default: csgm')
        command.add_argument('--namespace', default='', metavar='N', help='of the node, where it is not in the root')
        command.add_argument(
            '--timeout', type=seconds, metavar='S', help='for the node to be there, and to answer; default: by command'
        )
    arguments = sys.argv[1:] if arguments is None else arguments
    own = remove_ros_args(['csgm', *arguments])[1:]
    options = parser.parse_args(own)
    node = f'{space(options.namespace)}/{options.node.strip("/")}' if options.namespace else options.node
    discovery = None if options.timeout else DISCOVERY  # a node that is not there is told soon
    try:
        with Client(node, options.timeout, arguments, discovery=discovery) as client:
            answer = getattr(client, options.command)()
    except NoAnswerError as error:
        print(f'csgm: {error}', file=sys.stderr)
        return NO_ANSWER
    if isinstance(answer, Status):
        print(status_text(answer))
        return 0
    print(answer.message)
    return 0 if answer.success else FAILED


if __name__ == '__main__':
    sys.exit(main())
