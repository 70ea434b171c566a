"""Talk to a running node by its services: ``csgm call``, for machines without the ``ros2`` command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from csgm_ros.ros.client.connection import NODE, PATIENCE, Answer, Client, NoAnswerError, Status

__all__ = ['Answer', 'Client', 'NoAnswerError', 'Status', 'call', 'main', 'status']

COMMANDS = {
    'configure': 'check the parameters and compile the kernels',
    'activate': 'listen to the clouds',
    'deactivate': 'rest, and cancel a running registration',
    'cleanup': 'back to unconfigured',
    'shutdown': 'finalize the node',
    'register': 'register the newest pair and wait for the verdict',
    'cancel': 'cancel the running registration',
    'status': 'state, verdict and how the inputs do',
}
FAILED, NO_ANSWER = 1, 2


def call(command: str, node: str = NODE, timeout: float = PATIENCE) -> Answer:
    """Do one command of :data:`COMMANDS` but ``status``, over a connection of its own.

    Raises
    ------
    NoAnswerError
        When there is no such node, or it does not answer in time.
    """
    with Client(node, timeout) as client:
        return getattr(client, command)()


def _command(name: str) -> Callable[..., Answer]:
    def command(node: str = NODE, timeout: float = PATIENCE) -> Answer:
        return call(name, node, timeout)

    command.__name__ = command.__qualname__ = name
    command.__doc__ = f'Ask the node: {COMMANDS[name]}.'
    return command


configure, activate, deactivate, cleanup, shutdown, register, cancel = map(_command, list(COMMANDS)[:-1])


def status(node: str = NODE, timeout: float = PATIENCE) -> Status:
    """Return state and diagnostics of a node."""
    with Client(node, timeout) as client:
        return client.status()


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
        command.add_argument('--timeout', type=float, default=PATIENCE, metavar='S', help='seconds to wait for it')
    options = parser.parse_args(arguments)
    try:
        if options.command == 'status':
            print(status_text(status(options.node, options.timeout)))
            return 0
        answer = call(options.command, options.node, options.timeout)
    except NoAnswerError as error:
        print(f'csgm: {error}', file=sys.stderr)
        return NO_ANSWER
    print(answer.message)
    return 0 if answer.success else FAILED


if __name__ == '__main__':
    sys.exit(main())
