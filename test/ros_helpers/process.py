"""Processes beside the test: the node, and whoever sends it clouds."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from csgm_ros.ros.dds import PROFILE_VARIABLE
from ros_helpers.waiting import until

ROOT = Path(__file__).parents[2]


class Process:
    """A Python process with its output in a file; it chooses its transports itself."""

    ROOT = ROOT

    def __init__(self, *arguments, env=None):
        self._log = tempfile.NamedTemporaryFile('w+', suffix='.log')  # noqa: SIM115 - closed by close()
        paths = [str(ROOT), str(ROOT / 'test'), os.environ.get('PYTHONPATH', '')]
        inherited = {name: value for name, value in os.environ.items() if name != PROFILE_VARIABLE}
        environment = {**inherited, 'PYTHONPATH': os.pathsep.join(paths), 'PYTHONUNBUFFERED': '1', **(env or {})}
        self.popen = subprocess.Popen(
            [sys.executable, *arguments], stdout=self._log, stderr=subprocess.STDOUT, env=environment
        )

    @property
    def pid(self):
        return self.popen.pid

    @property
    def log(self):
        return Path(self._log.name).read_text()

    def wait_log(self, text, timeout=60.0):
        until(lambda: text in self.log or self.popen.poll() is not None, f'{text!r} in the log', timeout)
        assert text in self.log, f'process ended with {self.popen.poll()}:\n{self.log}'

    def signal(self, number):
        self.popen.send_signal(number)

    def wait(self, timeout=30.0):
        return self.popen.wait(timeout)

    def kill(self):
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()

    def end(self):
        """End it in a way that lets the middleware clean up."""
        if self.popen.poll() is None:
            self.signal(signal.SIGINT)
            self.popen.wait(20.0)


class NodeProcess(Process):
    """The node, started as a user starts it."""

    def __init__(self, *ros_arguments, env=None, module='csgm_ros.ros.node'):
        often = ('-p', 'diagnostics_period:=0.1')
        super().__init__('-m', module, '--ros-args', *often, *ros_arguments, env=env)

    def close(self):
        """End it by SIGINT and expect a clean exit."""
        if self.popen.poll() is None:
            self.signal(signal.SIGINT)
        try:
            code = self.wait(20.0)
            assert code == 0, f'the node ended with {code}:\n{self.log}'
        finally:
            self.kill()
            self._log.close()

    def threads(self):
        return len(os.listdir(f'/proc/{self.pid}/task'))

    def descriptors(self):
        return len(os.listdir(f'/proc/{self.pid}/fd'))

    def resident_mb(self):
        pages = int(Path(f'/proc/{self.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 2**20
