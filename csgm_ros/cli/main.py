"""The command line, `csgm`: everything that a person does with files, bags and the node."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from importlib import import_module

from csgm_ros.errors import CsgmError, DegenerateCloudError, InputError

ACCEPTED, BAD_INPUT, REJECTED, INTERRUPTED = 0, 2, 3, 130
NEW_OBJECTS = 100_000  # before garbage is looked for: what is imported is none, and looking takes a tenth of the start
EPILOG = """\
examples:
  csgm simulate pair/                                      a synthetic Kinect and SfM cloud with known truth
  csgm register pair/sfm.ply pair/kinect.ply --output fused.ply
  csgm demo                                                the same through the live ROS 2 node

exit codes: 0 accepted, 3 rejected, 2 bad input or usage, 130 interrupted"""

# Commands that speak ROS and read their own arguments: name -> (module, help).
ROS_COMMANDS = {
    'replay': ('csgm_ros.ros.client.player', 'play a rosbag2 bag into the live node'),
    'call': ('csgm_ros.ros.client.commands', 'call the live node: configure, activate, register, status ...'),
}
BATCH = 'register many pairs, report on them, align their clouds; needs csgm_ros[batch]'


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str):
        self.exit(BAD_INPUT, f'{self.prog}: {message}; see {self.prog} --help\n')


def main(arguments: list[str] | None = None) -> int:
    """Run `csgm` and return its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    gc.set_threshold(NEW_OBJECTS)
    try:
        if arguments and arguments[0] in ROS_COMMANDS:
            return _ros_command(arguments[0], arguments[1:])
        if arguments and arguments[0] == 'batch':
            return _batch(arguments[1:])
        options = _parser().parse_args(arguments)
        return options.run(options)
    except CsgmError as error:
        print(f'csgm: {error}', file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:  # the reader of our output has seen enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return INTERRUPTED
    except KeyboardInterrupt:
        print('csgm: interrupted', file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    shape = argparse.RawDescriptionHelpFormatter
    parser = _Parser(
        prog='csgm', description='Registers clouds of different sensors.', epilog=EPILOG, formatter_class=shape
    )
    commands = parser.add_subparsers(metavar='COMMAND', required=True, parser_class=_Parser)
    adders = (_add_register, _add_view, _add_apply, _add_export, _add_prepare_map, _add_demo, _add_inspect, _add_config)
    for add in (*adders, _add_simulate, _add_record_demo):
        add(commands)
    for name, (_, text) in ROS_COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    commands.add_parser('batch', help=BATCH, add_help=False)
    return parser


def _add_register(commands) -> None:
    parser = commands.add_parser('register', help='register two files, or two topics of a bag')
    parser.add_argument('source', nargs='?', help='cloud to move, such as SfM; the README lists the formats')
    parser.add_argument('target', nargs='?', help='cloud that stays, such as Kinect')
    parser.add_argument('--profile', choices=('robust', 'paper'), help='default: robust')
    parser.add_argument('--config', metavar='F', help='YAML file of parameters; see `csgm config`')
    parser.add_argument('--set', metavar='NAME=VALUE', action='append', default=[], help='one parameter; repeatable')
    parser.add_argument('--seed', type=_seed, default=0, metavar='N', help='default: 0')
    parser.add_argument('--initial', metavar='F', help='JSON of where it is expected: T_target_source, 4 x 4')
    parser.add_argument(
        '--initial-sigma',
        metavar=('PLACE', 'DEGREES', 'SCALE'),
        nargs=3,
        type=float,
        help='how well: target units (0: a fifth of the radius), degrees, relative; default: 0 15 0.1',
    )
    parser.add_argument('--output', metavar='F', help='write the fused cloud, in the frame of the target')
    parser.add_argument('--json', metavar='F', help='write the result for programs')
    parser.add_argument('--report', metavar='F', help='write one .html page that shows the result and why')
    parser.add_argument('--picture', metavar='F', help='write a .png of before, after and slices')
    parser.add_argument('--bag', metavar='BAG', help='read the clouds from a rosbag2 bag instead')
    parser.add_argument('--source-topic', metavar='T', default='/source', help='default: /source')
    parser.add_argument('--target-topic', metavar='T', default='/target', help='default: /target')
    parser.set_defaults(run=_register)


def _add_view(commands) -> None:
    parser = commands.add_parser('view', help='show a result in a window: Rerun where it is installed, else Open3D')
    parser.add_argument('result', help='what register --json wrote')
    parser.add_argument('clouds', metavar='CLOUD', nargs='*', help='source and target, where they were moved since')
    parser.set_defaults(run=_view)


def _add_apply(commands) -> None:
    parser = commands.add_parser('apply', help='move a further cloud by the transform of a result')
    parser.add_argument('result', help='what register --json wrote')
    parser.add_argument('cloud', help='in the frame of the source')
    parser.add_argument('-o', '--output', metavar='F', required=True, help='the cloud in the frame of the target')
    parser.add_argument('--rejected', action='store_true', help='also where the result was rejected')
    parser.set_defaults(run=_apply)


def _add_export(commands) -> None:
    parser = commands.add_parser('export-transform', help='the transform of a result for other tools')
    parser.add_argument('result', help='what register --json wrote')
    parser.add_argument('--format', choices=('colmap', 'cloudcompare', 'ros', 'matlab'), required=True)
    parser.add_argument('-o', '--output', metavar='F', help='default: printed')
    parser.add_argument('--rejected', action='store_true', help='also where the result was rejected')
    parser.set_defaults(run=_export)


def _add_prepare_map(commands) -> None:
    parser = commands.add_parser('prepare-map', help='make a map ready for tracking, once')
    parser.add_argument('map', metavar='MAP', help='cloud of any unit and pose, such as an SfM one')
    parser.add_argument('-o', '--output', required=True, metavar='FILE.npz')
    parser.set_defaults(run=_prepare_map)


def _add_demo(commands) -> None:
    parser = commands.add_parser('demo', help='the live node registers a synthetic pair, or two files')
    parser.add_argument('--source', metavar='F', help='default: a simulated SfM cloud')
    parser.add_argument('--target', metavar='F', help='default: a simulated Kinect cloud')
    parser.add_argument('--tracking', action='store_true', help='follow a simulated sensor through a map instead')
    parser.add_argument(
        '--rate', type=_rate, default=1.0, metavar='R', help='of --tracking: 1 is real time, less suits a busy machine'
    )
    parser.add_argument('--seed', type=_seed, default=0, metavar='N', help='of the scene and of the registration')
    parser.add_argument('--output', metavar='DIR', default='demo_output', help='default: demo_output')
    parser.set_defaults(run=_demo)


def _add_inspect(commands) -> None:
    parser = commands.add_parser('inspect', help='what a cloud is like, parameters that suit it, what to expect of two')
    parser.add_argument('files', metavar='FILE', nargs='+')
    parser.add_argument('--picture', metavar='F', help='write a .png of the supervoxels')
    parser.set_defaults(run=_inspect)


def _add_config(commands) -> None:
    parser = commands.add_parser('config', help='print every parameter with its description, as YAML')
    parser.add_argument('--profile', choices=('robust', 'paper'), default='robust')
    parser.set_defaults(run=_config)


def _add_simulate(commands) -> None:
    parser = commands.add_parser('simulate', help='write a synthetic Kinect and SfM cloud and their truth')
    parser.add_argument('folder')
    parser.add_argument('--seed', type=_seed, default=0, metavar='N')
    parser.set_defaults(run=_simulate)


def _add_record_demo(commands) -> None:
    parser = commands.add_parser('record-demo', help='write the synthetic pair as a rosbag2 bag')
    parser.add_argument('bag')
    parser.add_argument('--seed', type=_seed, default=0, metavar='N')
    parser.set_defaults(run=_record_demo)


def _register(options) -> int:
    from csgm_ros.io import files
    from csgm_ros.io import results as report
    from csgm_ros.io.config_files import assignment, read_config

    config = read_config(options.config, options.profile)
    for text in options.set:
        config = assignment(config, text)
    if options.output:
        files.check_writable(options.output)
    if options.json:
        files.check_writable(options.json, ('.json',))
    if options.report:
        files.check_writable(options.report, ('.html',))
    if options.picture:
        files.check_writable(options.picture, ('.png',))
    prior = _prior(options)
    source, target = _clouds(options, config)
    for name, cloud in (('source', source), ('target', target)):
        _say_left_out(name, cloud.points)

    from csgm_ros.registration import register

    try:
        with report.ProgressBar() as progress:
            shown = bool(options.report)
            asked = {'seed': options.seed, 'on_progress': progress, 'details': shown, 'prior': prior}
            result = register(source.points, target.points, config, **asked)
    except InputError as error:
        where = options.bag or f'source {options.source}, target {options.target}'
        raise InputError(f'{error} ({where})') from None
    print(report.summary(result))
    if options.json:
        report.write_json(options.json, result, _inputs(options))
    _show(options, result, source, target)
    if options.output and result.accepted:
        files.write(options.output, report.fused(source, target, result.transform))
    elif options.output:
        print(f'csgm: {options.output} is not written, as the result is rejected', file=sys.stderr)
    written = [options.json, options.report, options.picture, options.output if result.accepted else None]
    if any(written):
        print(f'written: {", ".join(filter(None, written))}')
    return ACCEPTED if result.accepted else REJECTED


def _prior(options):
    """Return what --initial and --initial-sigma say, None where they say nothing."""
    from csgm_ros.config import NodeConfig
    from csgm_ros.io.transforms import read_result
    from csgm_ros.types import Prior

    if not options.initial:
        if options.initial_sigma:
            raise InputError('--initial-sigma needs --initial, which says what is that uncertain')
        return None
    return Prior(read_result(options.initial)[0], tuple(options.initial_sigma or NodeConfig().initial_sigma))


def _say_left_out(name: str, points) -> None:
    """Say which points the registration leaves out at once; the output keeps them."""
    import numpy as np

    from csgm_ros.cloud.outliers import without_extremes

    finite = points[np.isfinite(points).all(axis=1)]
    extreme = len(finite) - len(without_extremes(finite))
    if extreme:
        print(f'csgm: {name}: {extreme} of {len(points)} points lie absurdly far out and are left out', file=sys.stderr)


def _show(options, result, source, target) -> None:
    names = (options.bag and (options.source_topic, options.target_topic)) or (options.source, options.target)
    names = tuple(name.rstrip('/').rsplit('/', 1)[-1] for name in names)
    if options.report:
        from csgm_ros.visual.report import write_report
        from csgm_ros.visual.report_data import report_data

        write_report(options.report, report_data(result, source, target, names))
    if options.picture:
        from csgm_ros.visual.pictures import before_after

        said = f'{names[0]} on {names[1]}: {"accepted" if result.accepted else "rejected"}, {result.reason}'
        before_after(options.picture, source, target, result.transform, said)


def _inputs(options) -> dict[str, str]:
    """Return where the clouds came from, for `csgm view`."""
    if options.bag:
        topics = {'source_topic': options.source_topic, 'target_topic': options.target_topic}
        return {'bag': os.path.abspath(options.bag), **topics}
    return {'source': os.path.abspath(options.source), 'target': os.path.abspath(options.target)}


def _view(options) -> int:
    from csgm_ros.io.transforms import read_inputs, read_result
    from csgm_ros.visual.window import view

    transform, accepted = read_result(options.result)
    if len(options.clouds) not in (0, 2):
        raise InputError('view takes both clouds, source and target, or neither')
    inputs = dict(zip(('source', 'target'), options.clouds, strict=False)) or read_inputs(options.result)
    source, target = _read(**inputs)
    view(source, target, transform, f'{options.result}: {"accepted" if accepted else "rejected"}')
    return ACCEPTED


def _read(source='', target='', bag='', source_topic='', target_topic=''):
    """Return both clouds whole."""
    from csgm_ros.io import bags, files

    if not bag:
        return files.read_cloud(source), files.read_cloud(target)
    pair = bags.read_clouds(bag, source_topic, target_topic)
    return tuple(files.CloudFile(cloud.points, None if cloud.colors is None else cloud.colors / 255) for cloud in pair)


def _apply(options) -> int:
    from csgm_ros.io import files
    from csgm_ros.io.results import moved

    files.check_writable(options.output)
    transform = _usable_transform(options)
    if transform is None:
        return REJECTED
    files.write(options.output, moved(files.read_cloud(options.cloud), transform))
    return ACCEPTED


def _export(options) -> int:
    from csgm_ros.io.atomic import write_text
    from csgm_ros.io.transforms import export

    transform = _usable_transform(options)
    if transform is None:
        return REJECTED
    text = export(transform, options.format)
    if options.output:
        write_text(options.output, text)
    else:
        print(text, end='')
    return ACCEPTED


def _usable_transform(options):
    """Return the transform of a result, or None, said, where it was rejected and that is not asked for."""
    from csgm_ros.io.transforms import read_result

    transform, accepted = read_result(options.result)
    if accepted or options.rejected:
        return transform
    print(
        f'csgm: {options.result} was rejected, so its transform is not used; --rejected uses it all the same',
        file=sys.stderr,
    )
    return None


def _clouds(options, config):
    """Return the source and the target that the options name; large ones thinned, where nothing else is asked for."""
    from csgm_ros.io import files

    if options.bag:
        if options.source or options.target:
            raise InputError('--bag replaces SOURCE and TARGET; give either')
        return _read(**_inputs(options))
    if not (options.source and options.target):
        raise InputError('register needs SOURCE and TARGET, or --bag; see csgm register --help')
    if options.output or options.report or options.picture:
        return _read(options.source, options.target)
    most, threads = config.preprocess.max_points, config.threads or os.cpu_count() or 1
    return tuple(files.CloudFile(files.read_points(path, most, threads)) for path in (options.source, options.target))


def _prepare_map(options) -> int:
    from csgm_ros.io.files import check_writable, read_cloud
    from csgm_ros.tracking.maps import prepare_map, save_map

    check_writable(options.output, ('.npz',))
    cloud = read_cloud(options.map)
    try:
        prepared = prepare_map(cloud.points)
    except InputError as error:
        raise InputError(f'{error} ({options.map})') from None
    save_map(options.output, prepared)
    print(f'{options.output}: {len(prepared.points)} of {len(cloud.points)} points, {prepared.voxel:.4g} apart')
    return 0


def _demo(options) -> int:
    from csgm_ros.demo import run as demo

    try:
        if options.tracking:
            if options.source or options.target:
                raise InputError('--tracking simulates its own map and sensor; leave out --source and --target')
            from csgm_ros.demo import track

            return track.run(options.output, options.seed, options.rate)
        return demo.run(options.source, options.target, options.output, options.seed)
    except demo.DemoError as error:
        print(f'csgm: {error}', file=sys.stderr)
        return demo.FAILED


def _inspect(options) -> int:
    from csgm_ros.cli.inspect import description, expectation, inspect_parts
    from csgm_ros.io.files import check_writable, point_parts

    if options.picture:
        check_writable(options.picture, ('.png',))
    found = []
    for path in options.files:
        try:
            found.append(inspect_parts(*point_parts(path)))
        except DegenerateCloudError as error:
            raise InputError(f'{error} ({path})') from None
        heading = '' if len(options.files) == 1 else f'{path}\n'
        print(f'{heading}{description(found[-1])}', end='\n' if len(options.files) == 1 else '\n\n')
    if len(found) == 2:
        print(f'{options.files[0]} on {options.files[1]}\n{expectation(*found)}')
    if options.picture:
        from csgm_ros.visual.pictures import supervoxels

        titles = (os.path.basename(path.rstrip('/')) for path in options.files)
        supervoxels(options.picture, list(zip(titles, (one.supervoxels for one in found), strict=True)))
    return 0


def _config(options) -> int:
    from csgm_ros.config import profile
    from csgm_ros.io.config_files import config_yaml

    print(config_yaml(profile(options.profile)), end='')
    return 0


def _simulate(options) -> int:
    from csgm_ros.demo import simulation

    simulation.write_pair(options.folder, options.seed)
    print(f'{options.folder}: kinect.ply, sfm.ply and truth.json (T_target_source)')
    return 0


def _record_demo(options) -> int:
    from csgm_ros.demo import simulation
    from csgm_ros.io import bags

    made = simulation.simulate(options.seed)
    bags.write_clouds(options.bag, simulation.recording(made), latched=('/source',))
    print(f'{options.bag}: /source (SfM, latched) and /target (Kinect); play it with csgm replay {options.bag}')
    return 0


def _ros_command(name: str, arguments: list[str]) -> int:
    """Hand over to a module that imports ROS."""
    try:
        module = import_module(ROS_COMMANDS[name][0])
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith('csgm_ros'):
            raise
        raise InputError(
            f'{name} needs {error.name}, which is not here; source a ROS 2 install or use the environment of `make`'
        ) from None
    return module.main(arguments) or 0


def _batch(arguments: list[str]) -> int:
    """Hand over to a module that imports what only the extra `batch` brings."""
    from csgm_ros.cli import batch

    try:
        return batch.main(arguments)
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith('csgm_ros'):
            raise
        raise InputError(f"batch needs {error.name}, which is not here; pip install 'csgm_ros[batch]'") from None


def _seed(text: str) -> int:
    seed = int(text)
    if seed < 0:
        raise ValueError
    return seed


def _rate(text: str) -> float:
    rate = float(text)
    if not 0.01 <= rate <= 10.0:
        raise ValueError
    return rate


_rate.__name__ = 'number from 0.01 to 10'
_seed.__name__ = 'non-negative whole number'  # argparse names it so: "invalid ... value: '-1'"

if __name__ == '__main__':
    sys.exit(main())
