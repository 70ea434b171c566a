"""A connection to a running node: its lifecycle, trigger, parameters and diagnostics."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from typing import Any

import rclpy
import rclpy.client
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from csgm_ros.errors import CsgmError
from csgm_ros.ros.dds import connection_error

NODE = 'csgm'
PATIENCE = 30.0  # seconds for an answer
REPORTING = 120.0  # seconds for a page about large clouds
TRIGGERS = ('register', 'cancel', 'save_report', 'relocalize')
DISCOVERY = 6.0  # seconds for a node to be found that is there: it takes up to three
CONFIGURING, REGISTERING = 300.0, 600.0  # seconds: compiling for the first time takes a minute
PROBE = 0.5
CLIENT = 'csgm_client_'
ANSWERS = QoSProfile(depth=1000)  # a service answers into the queue of each client: of 10, others' push ours out


class NoAnswerError(CsgmError):
    """The node is not there, or does not answer in time."""


@dataclass(frozen=True)
class Answer:
    """What the node said: ``success``, and one line for a person."""

    success: bool
    message: str


@dataclass(frozen=True)
class Status:
    """What the node says of itself.

    Attributes
    ----------
    state : str
        Lifecycle state.
    message : str
        One line on the registration, or on tracking.
    values : dict of str to dict of str to str
        Diagnostics: the facts under ``registration`` or ``tracking``, and under the names of the inputs.
    """

    state: str
    message: str
    values: dict[str, dict[str, str]] = field(default_factory=dict)


class Client:
    """A connection to one node; use as a context manager, from one thread.

    Parameters
    ----------
    node : str
        Name of the node, with its namespace if it has one: ``csgm``, ``/robot/csgm``. Without a slash before it
        it is in the namespace of the client, the root where ``ros_arguments`` say nothing else.
    timeout : float, optional
        Seconds to wait for the node to be there, and for each answer. Default: :data:`PATIENCE`; configuring and
        registering may take longer.
    ros_arguments : list of str, optional
        As any ROS program takes them, from ``--ros-args`` on.
    discovery : float, optional
        Seconds to wait for the node to be there; default: ``timeout``.
    """

    def __init__(
        self,
        node: str = NODE,
        timeout: float | None = None,
        ros_arguments: list[str] | None = None,
        *,
        discovery: float | None = None,
    ):
        self.node_name = node
        self._asked, self._discovery, self._ros_arguments = timeout, discovery or timeout, ros_arguments
        self.timeout = timeout or PATIENCE

    def __enter__(self) -> Client:
        self._context = rclpy.Context()
        try:
            rclpy.init(args=self._ros_arguments, context=self._context)
            self._node = rclpy.create_node(
                f'{CLIENT}{os.getpid()}', context=self._context, start_parameter_services=False, enable_rosout=False
            )
        except (RCLError, UnknownROSArgsError) as error:
            self._context.try_shutdown()
            raise NoAnswerError(f'ROS cannot be joined: {connection_error(error)}') from None
        if not self.node_name.startswith('/'):
            self.node_name = f'{self._node.get_namespace().rstrip("/")}/{self.node_name}'
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        kinds = {'change_state': ChangeState, 'get_available_transitions': GetAvailableTransitions}
        self._triggers = {name: self._create(Trigger, name) for name in TRIGGERS}
        self._clients = {name: self._create(kind, name) for name, kind in kinds.items()}
        self._parameters = AsyncParameterClient(self._node, self.node_name, qos_profile=ANSWERS)
        self._clients['get_state'] = self._create(GetState, 'get_state')
        try:
            self._connect()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def configure(self, timeout: float | None = None) -> Answer:
        """Configure the node; compiling its kernels for the first time may take a minute."""
        return self._change(Transition.TRANSITION_CONFIGURE, 'configured', timeout or self._asked or CONFIGURING)

    def activate(self) -> Answer:
        """Let the node listen."""
        return self._change(Transition.TRANSITION_ACTIVATE, 'active')

    def deactivate(self) -> Answer:
        """Let the node rest; a running registration is cancelled."""
        return self._change(Transition.TRANSITION_DEACTIVATE, 'inactive')

    def cleanup(self) -> Answer:
        """Take the node back to unconfigured."""
        return self._change(Transition.TRANSITION_CLEANUP, 'unconfigured')

    def shutdown(self) -> Answer:
        """Finalize the node from whatever state it is in; its process lives until it is told to end."""
        transitions = {
            'unconfigured': Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
            'inactive': Transition.TRANSITION_INACTIVE_SHUTDOWN,
            'active': Transition.TRANSITION_ACTIVE_SHUTDOWN,
        }
        state = self.state()
        if state not in transitions:
            return Answer(False, f'the node is {state}')
        return self._change(transitions[state], 'finalized')

    def register(self, timeout: float | None = None) -> Answer:
        """Register the newest pair and wait for the verdict.

        Raises
        ------
        NoAnswerError
            When there is none in time; the node works on.
        """
        timeout = timeout or self._asked or REGISTERING
        try:
            return self._trigger('register', timeout)
        except NoAnswerError:
            raise NoAnswerError(
                f'{self.node_name} has no verdict within {timeout:g} s and works on; wait longer, or call cancel'
            ) from None

    def cancel(self) -> Answer:
        """Cancel the running registration."""
        return self._trigger('cancel', self.timeout)

    def save_report(self) -> Answer:
        """Write the page of the last registration; the message is its path."""
        return self._trigger('save_report', max(self.timeout, REPORTING))

    def relocalize(self) -> Answer:
        """Let a node that tracks forget the place and search everywhere."""
        return self._trigger('relocalize', self.timeout)

    def state(self) -> str:
        """Return the lifecycle state."""
        return self._call('get_state', GetState.Request(), self.timeout).current_state.label

    def transitions(self) -> list[str]:
        """Return the transitions that are possible now."""
        request = GetAvailableTransitions.Request()
        found = self._call('get_available_transitions', request, self.timeout)
        return [each.transition.label for each in found.available_transitions]

    def status(self) -> Status:
        """Return state and diagnostics, as the node says them once a second."""
        heard: list = []
        state = self.state()
        prefix = self.node_name[1:].replace('/', '.') + ': '

        def receive(message: DiagnosticArray) -> None:
            heard.extend(status for status in message.status if status.name.startswith(prefix))

        subscription = self._node.create_subscription(DiagnosticArray, '/diagnostics', receive, 10)
        self._spin_until(lambda: heard, self.timeout, f'{self.node_name} says nothing on /diagnostics')
        self._node.destroy_subscription(subscription)
        values = {each.name[len(prefix) :]: {pair.key: pair.value for pair in each.values} for each in heard}
        for each in heard:
            values[each.name[len(prefix) :]]['message'] = each.message
        return Status(state, heard[0].message, values)

    def set_parameters(self, values: dict[str, Any]) -> Answer:
        """Set parameters as a whole: all of them or, with the reason, none."""
        client = self._parameters
        future = client.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
        result = self._result(future, self.timeout, 'set_parameters_atomically').result
        return Answer(result.successful, result.reason or 'set')

    def get_parameters(self, names: list[str]) -> dict[str, Any]:
        """Return the values of parameters."""
        future = self._parameters.get_parameters(names)
        values = self._result(future, self.timeout, 'get_parameters').values
        found = [rclpy.parameter.parameter_value_to_python(value) for value in values]
        return dict(zip(names, found, strict=True))

    def all_parameters(self) -> dict[str, Any]:
        """Return every parameter of the node with its value."""
        future = self._parameters.list_parameters([], 0)
        return self.get_parameters(self._result(future, self.timeout, 'list_parameters').result.names)

    def _create(self, kind: type, service: str) -> rclpy.client.Client:
        return self._node.create_client(kind, f'{self.node_name}/{service}', qos_profile=ANSWERS)

    def _connect(self) -> None:
        """Ask for the state until it is answered, and wait for the other services.

        A node drops the answer to a client that it has not discovered yet. Discovery keeps the order in which clients
        were created: once the last one is answered, all are. A request to a service that is not discovered yet is
        lost, too, and the services of the node come in an order of their own.
        """
        client, start = self._clients['get_state'], time.monotonic()
        patience = self._discovery or PATIENCE
        while time.monotonic() < start + patience:
            future = client.call_async(GetState.Request())
            self._executor.spin_until_future_complete(future, timeout_sec=PROBE)
            if future.done():
                self._spin_until(self._all_there, self.timeout, f'{self.node_name} lacks services of a csgm node')
                return
            client.remove_pending_request(future)
            if self.node_name in self._nodes():
                patience = self.timeout  # it is there, and busy
        raise NoAnswerError(self._absent(patience))

    def _all_there(self) -> bool:
        return all(each.service_is_ready() for each in self._clients.values()) and self._parameters.services_are_ready()

    def _change(self, transition: int, goal: str, timeout: float | None = None) -> Answer:
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self._call('change_state', request, timeout or self.timeout)
        if answer.success:
            return Answer(True, goal)
        possible = ', '.join(self.transitions())
        return Answer(False, f'not {goal}: the node is {self.state()}, its log may tell why; possible: {possible}')

    def _trigger(self, service: str, timeout: float) -> Answer:
        """Call a service that the node has in one of its modes only."""
        client = self._triggers[service]
        self._spin_until(client.service_is_ready, DISCOVERY, f'{self.node_name} has no {service} in its mode')
        answer = self._result(client.call_async(Trigger.Request()), timeout, service)
        return Answer(answer.success, answer.message)

    def _call(self, service: str, request: Any, timeout: float) -> Any:
        return self._result(self._clients[service].call_async(request), timeout, service)

    def _nodes(self) -> list[str]:
        """Return the nodes there are, but for clients such as this one."""
        found = self._node.get_node_names_and_namespaces()
        return sorted({f'{space.rstrip("/")}/{name}' for name, space in found if not name.startswith(CLIENT)})

    def _absent(self, patience: float) -> str:
        others = self._nodes()
        if self.node_name in others:
            return f'{self.node_name} is there and does not answer within {patience:g} s'
        there = f'there are {", ".join(others)}' if others else 'there is none at all; is it started, in this domain?'
        return f'no node {self.node_name} in this ROS domain within {patience:g} s; {there}'

    def _result(self, future: rclpy.Future, timeout: float, service: str) -> Any:
        self._spin_until(future.done, timeout, f'{self.node_name} did not answer {service} within {timeout:g} s')
        return future.result()

    def _spin_until(self, condition: Any, timeout: float, complaint: str) -> None:
        end = time.monotonic() + timeout
        while not condition():
            if (left := end - time.monotonic()) <= 0:
                raise NoAnswerError(complaint)
            self._executor.spin_once(timeout_sec=min(left, 0.1))
