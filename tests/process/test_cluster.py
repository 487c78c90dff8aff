"""Jobs on the workers of a real scheduler have the same results as in one process, whatever happens to a worker."""

from __future__ import annotations

import copy
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.process import cluster as cluster_module
from q2r2_control.process.cluster import Cluster
from q2r2_control.process.places import HERE, chosen_place
from tests.support.dask_cluster import DaskCluster, dask_cluster, die_once

JOBS = list(range(20))


def square(number: int) -> int:
    return number * number


def square_or_die(folder: Path, number: int) -> int:
    """Return the square. The fourth job ends its worker once."""
    if number == 3:
        die_once(folder)
    return number * number


class DeadlyWork:
    """Squares numbers. The first worker that receives this work ends at once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return received, (self._folder,)

    def __call__(self, number: int) -> int:
        return square(number)


def received(folder: Path) -> Callable[[int], int]:
    die_once(folder)
    return square


def kill(process: int, number: int) -> None:
    os.kill(process, 9)


def fail_from_two_on(number: int) -> int:
    if number >= 2:
        raise ConfigError(f"job {number}: allowed: 0, 1")
    return number


def name_in_folder(file: Path) -> str:
    """Return the file's name and text. A relative path begins at the sender's working directory."""
    return f"{file}: {file.read_text()}"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with dask_cluster(tmp_path_factory.mktemp("cluster")) as found:
        yield found


def fault_of(place: Cluster, **options: object) -> str:
    """Return the message of the error with which all jobs are refused before any job begins."""
    with pytest.raises(ConfigError) as fault:
        list(place.results(square, JOBS, **options))  # type: ignore[arg-type]
    assert "\n" not in str(fault.value)
    assert place.where == ""
    return str(fault.value)


@pytest.mark.slow
def test_jobs_of_a_killed_worker_run_on_the_other_worker_and_each_result_comes_once_in_order(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with dask_cluster(tmp_path) as cluster:
        place = Cluster(cluster.address)
        assert list(place.results(partial(square_or_die, tmp_path), JOBS)) == list(HERE.results(square, JOBS))
        assert (tmp_path / "died").exists()
        assert place.where == f" ({os.uname().nodename}: {len(JOBS)})"


@pytest.mark.slow
def test_a_worker_that_ends_while_workers_are_compared_prevents_no_job(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with dask_cluster(tmp_path) as cluster:
        results = Cluster(cluster.address).results(DeadlyWork(tmp_path), JOBS)
        assert list(results) == list(HERE.results(square, JOBS))
        assert (tmp_path / "died").exists()


@pytest.mark.slow
def test_the_error_of_the_first_job_that_fails_is_raised_after_the_results_of_all_jobs_before_it(
    cluster: DaskCluster,
) -> None:
    results = Cluster(cluster.address).results(fail_from_two_on, JOBS)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ConfigError, match="job 2: allowed: 0, 1"):
        next(results)


@pytest.mark.slow
def test_a_file_that_a_worker_cannot_see_is_named_before_any_job_begins(cluster: DaskCluster, tmp_path: Path) -> None:
    if sys.platform != "linux":
        pytest.skip("looks into /proc")
    (file := tmp_path / "seen").write_text("seen")
    with file.open() as stream:
        own = os.dup2(stream.fileno(), 900)  # No worker has a file with this descriptor open.
        line = fault_of(Cluster(cluster.address), reads=lambda job: file if job else Path(f"/proc/self/fd/{own}"))
        os.close(own)
    assert f"cannot see /proc/self/fd/{own}; allowed: a folder that all machines share" in line


@pytest.mark.slow
def test_a_relative_path_means_the_same_file_for_a_worker_as_for_the_sender(
    cluster: DaskCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "note").write_text("found")
    monkeypatch.chdir(tmp_path)
    place = Cluster(cluster.address)
    results = place.results(name_in_folder, [Path("note")], lambda file: file, tmp_path)
    assert list(results) == ["note: found"]
    # The files that tested whether the workers see the folder have been deleted.
    assert [file.name for file in tmp_path.iterdir()] == ["note"]


@pytest.mark.slow
def test_a_worker_whose_version_of_this_package_or_of_python_differs_from_ours_causes_an_error_of_one_line(
    cluster: DaskCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as changed:
        changed.setattr(cluster_module, "hash_of_sources", lambda: "of another commit")
        assert "another q2r2_control than here" in fault_of(Cluster(cluster.address))
    from distributed import versions

    ours = versions.get_versions(cluster_module._COMPARED)
    assert cluster_module._other_version(ours, ours) is None
    its = copy.deepcopy(ours)
    its["packages"]["numpy"] = None
    assert str(cluster_module._other_version(ours, its)).startswith("no numpy, and here is ")
    its["host"]["python"] = "3.99.0.final.0"
    assert str(cluster_module._other_version(ours, its)).startswith("Python 3.99.0.final.0, and here is ")
    monkeypatch.setattr(versions, "get_system_info", lambda: {"python": "3.99.0.final.0"})
    assert "and here is 3.99.0.final.0; allowed: the same on all machines" in fault_of(Cluster(cluster.address))


@pytest.mark.slow
def test_a_scheduler_that_cannot_do_the_work_raises_an_error_of_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with dask_cluster(tmp_path, workers=0) as cluster:
        assert "it has no workers" in fault_of(Cluster(cluster.address))
        cluster.add_workers(1, threads=2)
        assert "does 2 jobs at once in one process; allowed: --nthreads 1" in fault_of(Cluster(cluster.address))
    monkeypatch.setattr(cluster_module, "_CONNECT_S", 0.1)
    assert "no scheduler answers there" in fault_of(Cluster(cluster.address))


class _Answers(logging.Handler):
    """Starts another worker as soon as a logged line says that no worker is left."""

    def __init__(self, cluster: DaskCluster) -> None:
        super().__init__()
        self._cluster, self.lines = cluster, list[str]()

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())
        self._cluster.add_workers(1)


@pytest.mark.slow
def test_jobs_wait_for_another_worker_if_none_is_left_and_fail_if_the_scheduler_ends(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with dask_cluster(tmp_path, workers=1) as cluster:
        answers, logger = _Answers(cluster), logging.getLogger(cluster_module.__name__)
        logger.addHandler(answers)
        try:
            assert list(Cluster(cluster.address).results(partial(square_or_die, tmp_path), JOBS)) == list(
                map(square, JOBS)
            )
        finally:
            logger.removeHandler(answers)
        assert answers.lines == [f"--cluster {cluster.address}: no worker is left; the jobs wait for another one"]
        with pytest.raises(ConfigError, match="the scheduler is gone; the same command begins again"):
            list(Cluster(cluster.address).results(partial(kill, cluster.scheduler), JOBS))


def test_if_dask_is_not_installed_the_error_says_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"--cluster needs dask.distributed: .*pip install .*\[cluster\]'"):
        chosen_place(1, "tcp://127.0.0.1:8786")


def test_workers_of_this_computer_and_a_cluster_exclude_each_other() -> None:
    with pytest.raises(ConfigError, match="--workers cannot be used with --cluster"):
        chosen_place(2, "tcp://127.0.0.1:8786")


def test_dask_is_imported_only_for_a_cluster() -> None:
    code = (
        "import sys; import q2r2_control.process.places, q2r2_control.cli.app as a\n"
        "try: a.app(['--help'])\nfinally: sys.exit(f'{ {\"dask\", \"distributed\"} & set(sys.modules)}')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "Move arms" in done.stdout
    assert done.stderr.splitlines()[-1] == "set()"


@pytest.mark.slow
def test_an_address_without_a_scheduler_and_another_file_end_a_program_with_one_line_only(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    (file := tmp_path / "notes.txt").write_text("no scheduler")
    for address in ("nonsense", str(file)):
        options = ["--seeds", "1", "--ticks", "100", "--cluster", address]
        command = [sys.executable, "-m", "q2r2_control", "soak", *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        told = "no scheduler answers there; allowed: its address, such as tcp://node01:8786, or its file"
        assert done.stderr.strip() == f"q2r2: --cluster {address}: {told}"
