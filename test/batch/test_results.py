"""Whatever stops a run, and wherever: no row is lost, none is there twice, none is torn."""

import os
import shutil
import subprocess

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('pyarrow')
from csgm_ros.batch import results as module
from csgm_ros.batch.results import Results, read, schema
from csgm_ros.errors import InputError


def row(number, *, failed=False):
    made = {'key': f'k{number}', 'id': f'pair {number}', 'accepted': not failed, 'failed': failed, 'seed': number}
    if failed:
        return made
    matrix = [1 / 3 + number] * 16
    return {**made, 'T_target_source': matrix, 'margin': float('inf'), 'timings': {'graph matching': 0.1}}


def dataset_ids(folder):
    """What any reader of Parquet sees."""
    import pyarrow.dataset as ds

    parts = list(folder.glob('part-*'))
    return ds.dataset(folder, schema=schema()).to_table()['id'].to_pylist() if parts else []


def test_rows_come_back_bit_for_bit(tmp_path):
    with Results(tmp_path) as results:
        results.append(row(0))
        results.append(row(1, failed=True))
        assert {r['id']: r['margin'] for r in read(tmp_path)} == {'pair 0': float('inf'), 'pair 1': None}
        results.commit()
    first, second = read(tmp_path)
    assert first['T_target_source'] == [1 / 3] * 16
    assert first['timings'] == {'graph matching': 0.1}
    assert second['failed']
    assert second['T_target_source'] is None


def test_a_row_that_is_there_is_not_added_again(tmp_path):
    for _ in range(2):
        with Results(tmp_path) as results:
            results.append(row(0))
            results.append(row(0))
            results.commit()
            results.append(row(0))
    assert dataset_ids(tmp_path) == ['pair 0']


def test_two_runs_do_not_write_to_one_folder(tmp_path):
    with Results(tmp_path), pytest.raises(InputError, match='another run writes there'):
        Results(tmp_path)


def test_failed_pairs_can_be_taken_out(tmp_path):
    with Results(tmp_path) as results:
        for number in range(4):
            results.append(row(number, failed=number % 2 == 1))
        assert results.drop_failed() == 2
        assert results.keys == {'k0', 'k2'}
        results.append(row(1))
    assert [r['id'] for r in read(tmp_path)] == ['pair 0', 'pair 1', 'pair 2']


@settings(max_examples=30)
@given(st.data())
def test_a_journal_cut_at_any_byte_loses_only_the_torn_row(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp('cut')
    with Results(folder) as results:
        ends = [0]
        for number in range(3):
            results.append(row(number))
            ends.append((folder / '_journal.jsonl').stat().st_size)
    cut = data.draw(st.integers(0, ends[-1]))
    os.truncate(folder / '_journal.jsonl', cut)
    with Results(folder) as results:
        assert len(results.keys) == max(i for i, end in enumerate(ends) if end - 1 <= cut)
        for number in range(3):
            results.append(row(number))
        results.commit()
    assert sorted(dataset_ids(folder)) == ['pair 0', 'pair 1', 'pair 2']
    shutil.rmtree(folder)


class Killed(BaseException):
    """Nothing that the code could catch as an error."""


@pytest.mark.parametrize('call', ['write', 'fsync', 'replace'])
def test_a_kill_at_any_system_call_loses_nothing_and_doubles_nothing(tmp_path, monkeypatch, call):
    """Rows in two parts and a journal; killed before or after the nth call, then run again."""
    monkeypatch.setattr(module, 'ROWS_A_PART', 2)
    real = getattr(os, call)
    for number in range(40):
        for late in (False, True):
            folder, left = tmp_path / f'{number}{late}', [number]

            def dying(*arguments, left=left, late=late):
                left[0] -= 1
                if left[0] == -1:
                    if late:
                        real(*arguments)
                    raise Killed
                return real(*arguments)

            acknowledged = []
            monkeypatch.setattr(module.os, call, dying)
            try:
                with Results(folder) as results:
                    for k in range(5):
                        results.append(row(k))
                        acknowledged.append(f'pair {k}')
                    results.commit()
            except Killed:
                pass
            monkeypatch.setattr(module.os, call, real)
            seen = dataset_ids(folder)
            assert len(seen) == len(set(seen))
            with Results(folder) as results:
                found = [r['id'] for r in read(folder)] if results.keys else []
                assert len(found) == len(set(found))
                assert set(acknowledged) <= set(found)
                for k in range(5):
                    results.append(row(k))
                results.commit()
            assert sorted(dataset_ids(folder)) == [f'pair {k}' for k in range(5)]
        if left[0] >= 0:
            return  # so many calls there are not
    pytest.fail('more calls than expected')


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 KiB; the test is told how to make it larger."""
    folder = tmp_path / 'disk'
    folder.mkdir()
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=64k', 'tmpfs', str(folder)]
    if os.getuid() or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip('no tmpfs can be mounted here')
    yield folder, lambda: subprocess.run(['mount', '-o', 'remount,size=8m', str(folder)], check=True)
    subprocess.run(['umount', '-l', str(folder)], check=True)


def append_until_full(results):
    for number in range(10_000):
        results.append(row(number))


def test_a_full_disk_ends_the_run_in_one_line_and_keeps_what_is_done(small_disk):
    folder, enlarge = small_disk
    with Results(folder) as results:
        with pytest.raises(InputError, match='what is done is kept: make room and run again'):
            append_until_full(results)
        with pytest.raises(InputError, match='make room'):  # nor does a part fit, and that loses nothing either
            results.commit()
    done = len(read(folder))
    assert done > 10
    assert [r['seed'] for r in sorted(read(folder), key=lambda r: r['seed'])] == list(range(done))
    enlarge()
    with Results(folder) as results:
        assert len(results.keys) == done
        for number in range(done + 5):
            results.append(row(number))
        results.commit()
    assert len(dataset_ids(folder)) == len(set(dataset_ids(folder))) == done + 5
