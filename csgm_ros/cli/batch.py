"""`csgm batch`: many pairs, their overview, and one frame for their clouds."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from csgm_ros.errors import InputError

EPILOG = """\
examples:
  csgm batch pairs.csv -o results/                         the pairs of a table: source,target[,id,seed,...]
  csgm batch scenes/ --source '*/sfm.ply' --target '*/kinect.ply' -o results/
  csgm batch --all-pairs scans/ -o results/ --scheduler tcp://head:8786
  csgm batch report results/                               results/report.html
  csgm batch align results/ -o poses.json                  one frame for all the clouds

Run it again after any interruption: what is done is not done again.
exit codes: 0 every pair has a row, 2 bad input or a run that could not end, 130 interrupted"""


def main(arguments: list[str]) -> int:
    """Run `csgm batch` with its arguments and return the exit code."""
    if arguments[:1] == ['report']:
        return _report(_report_parser().parse_args(arguments[1:]))
    if arguments[:1] == ['align']:
        return _align(_align_parser().parse_args(arguments[1:]))
    return _run(_run_parser().parse_args(arguments))


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str):
        self.exit(2, f'{self.prog}: {message}; see {self.prog} --help\n')


def _run_parser() -> argparse.ArgumentParser:
    shape = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog='csgm batch', description=__doc__, epilog=EPILOG, formatter_class=shape)
    parser.add_argument('pairs', nargs='?', help='a CSV file, or a folder with one pair in each of its subfolders')
    parser.add_argument('-o', '--output', metavar='RESULTS', required=True, help='folder of the Parquet data set')
    parser.add_argument('--source', metavar='GLOB', default='*/source.*', help="in a folder; default: '*/source.*'")
    parser.add_argument('--target', metavar='GLOB', default='*/target.*', help="in a folder; default: '*/target.*'")
    parser.add_argument('--all-pairs', metavar='FOLDER', nargs='+', help='every two clouds of these folders')
    parser.add_argument('--glob', default='*', help="which files of --all-pairs; default: '*'")
    parser.add_argument('--profile', choices=('robust', 'paper'), help='default: robust')
    parser.add_argument('--config', metavar='F', help='YAML file of parameters; see `csgm config`')
    parser.add_argument('--set', metavar='NAME=VALUE', action='append', default=[], help='one parameter; repeatable')
    parser.add_argument('--seed', type=_count, default=0, metavar='N', help='default: 0')
    parser.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster, or its scheduler file')
    parser.add_argument('--workers', type=_count, default=0, metavar='N', help='default: one a core, memory allowing')
    parser.add_argument('--threads', type=_count, default=0, metavar='N', help='a pair; default: shared cores')
    parser.add_argument('--reports', action='store_true', help='write a page of each pair to RESULTS/reports')
    parser.add_argument('--retries', type=_count, default=2, metavar='N', help='of a pair that kills its worker')
    parser.add_argument('--retry-failed', action='store_true', help='try pairs again that failed in an earlier run')
    return parser


def _report_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog='csgm batch report', description='Write an overview that sorts and filters, as HTML.')
    parser.add_argument('results', metavar='RESULTS')
    parser.add_argument('-o', '--output', metavar='F', help='default: RESULTS/report.html')
    parser.add_argument('--thumbnails', type=_count, default=500, metavar='N', help='at most; default: 500')
    return parser


def _align_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog='csgm batch align', description='Bring the clouds of accepted pairs into one frame.')
    parser.add_argument('results', metavar='RESULTS')
    parser.add_argument('-o', '--output', metavar='F', required=True, help='poses, .json')
    parser.add_argument('--root', metavar='CLOUD', help='whose frame and unit to take; default: most pairs')
    return parser


def _run(options) -> int:
    from csgm_ros.batch import pairs as lists
    from csgm_ros.batch.results import Results
    from csgm_ros.batch.run import asking, cluster, run
    from csgm_ros.io.config_files import assignment, read_config

    config = read_config(options.config, options.profile)
    for text in options.set:
        config = assignment(config, text)
    if bool(options.pairs) == bool(options.all_pairs):
        raise InputError('batch needs either PAIRS or --all-pairs FOLDER; see csgm batch --help')
    if options.all_pairs:
        pairs = lists.all_pairs(options.all_pairs, options.glob, config, options.seed)
    elif Path(options.pairs).is_dir():
        pairs = lists.from_folder(options.pairs, options.source, options.target, config, options.seed)
    else:
        pairs = lists.from_table(options.pairs, config, options.seed)
    with Results(options.output) as results:
        if options.retry_failed:
            results.drop_failed()
        left = sum(pair.key not in results.keys for pair in pairs)
        print(f'csgm: {len(pairs)} pairs, {len(pairs) - left} done earlier', file=sys.stderr)
        if not left:
            results.commit()
            return 0
        resources = options.scheduler, options.workers
        with cluster(*resources, threads=options.threads, retries=options.retries) as (client, threads):
            with asking(client):
                slots, dashboard = sum(client.nthreads().values()), client.dashboard_link
            print(f'csgm: {slots} workers, dashboard {dashboard}', file=sys.stderr)
            if not slots:
                print('csgm: the scheduler has no workers yet; waiting for them', file=sys.stderr)
            pages = _pages(options.output) if options.reports else ''
            counts = run(pairs, results, client, threads=threads, retries=options.retries, pages=pages)
    said = ', '.join(f'{counts[kind]} {kind}' for kind in ('accepted', 'rejected', 'failed'))
    print(f'{options.output}: {len(pairs)} pairs ({said}; {counts["earlier"]} done earlier)')
    return 0


def _pages(results: str) -> str:
    folder = Path(results, 'reports').absolute()
    folder.mkdir(exist_ok=True)
    return str(folder)


def _report(options) -> int:
    from csgm_ros.batch.report import write_report

    path = options.output or Path(options.results) / 'report.html'
    print(write_report(options.results, path, options.thumbnails))
    return 0


def _align(options) -> int:
    from csgm_ros.batch.align import align

    print(align(options.results, options.output, options.root))
    return 0


def _count(text: str) -> int:
    number = int(text)
    if number < 0:
        raise ValueError
    return number


_count.__name__ = 'non-negative whole number'  # argparse names it so
