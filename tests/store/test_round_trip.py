"""What is pulled is what was pushed, byte for byte; what has not changed does not travel."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from manip_il.data.build import build
from manip_il.data.journal import Journal
from manip_il.data.lerobot_layout import TASKS
from manip_il.data.lerobot_write import write_dataset
from manip_il.data.schema import RobotTaskSpec
from manip_il.doctor.finding import NotWhole
from manip_il.errors import FolderExistsError, UsageError
from manip_il.mdp import Episode
from manip_il.store.errors import ConflictError, ManifestError, NotFoundError
from manip_il.store.pull import pull
from manip_il.store.push import push, scan

from .s3 import Proxy
from .trees import content, impatient, make_run, silent, unwatched


@pytest.fixture
def dataset(tmp_path: Path, spec: RobotTaskSpec, make_episode: Callable[..., Episode]) -> Path:
    for seed in (1, 2):
        Journal(tmp_path / "d.journals", spec, {}).write(make_episode(seed))
    build(tmp_path / "d.journals", tmp_path / "d")
    return tmp_path / "d"


def test_a_run_comes_back_as_it_was(place: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    url, remote = impatient(place)
    _, published = push(run, url, remote, silent)
    assert published is not None
    assert published.uploaded == len(content(run)) - 1  # all but the link
    url, remote = impatient(place)
    pull(url, remote, tmp_path / "got", silent)
    assert content(tmp_path / "got") == content(run)
    assert not list(tmp_path.glob(".got*"))


def test_journals_go_along_when_asked_and_lie_beside_again(tmp_path: Path, dataset: Path) -> None:
    url, remote = impatient(f"file://{tmp_path}/store")
    for asked in (False, True):
        push(dataset, url, remote, silent, journals=asked)
        pull(url, remote, tmp_path / "got", silent, overwrite=True)
        assert content(tmp_path / "got") == content(dataset)
        assert (tmp_path / "got.journals").exists() == asked
    assert content(tmp_path / "got.journals") == content(tmp_path / "d.journals")
    shutil.rmtree(tmp_path / "got")  # as a kill between the two renames leaves it
    pull(url, remote, tmp_path / "got", silent)
    assert content(tmp_path / "got") == content(dataset)


def test_only_changes_travel(place: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    url, remote = impatient(place)
    push(run, url, remote, silent)
    (run / "same.json").write_text("[1]")
    (run / "new.json").write_text("[12]")
    (run / "empty.txt").unlink()
    plan, published = push(run, url, remote, silent)
    assert (plan.upload, plan.size, plan.remove) == (("new.json", "same.json"), 7, ("empty.txt",))
    assert (published.uploaded, published.size, published.removed) == (2, 7, 1)
    _, published = push(run, url, remote, silent)
    assert (published.uploaded, published.removed) == (0, 0)
    pull(url, remote, tmp_path / "got", silent)
    assert content(tmp_path / "got") == content(run)


@pytest.mark.parametrize("more", [0, 40])  # few objects are asked for one by one, many are listed
def test_what_the_store_has_lost_is_uploaded_again(place: str, more: int, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1, files=2 + more, size=100)
    url, remote = impatient(place)
    plan, published = push(run, url, remote, silent)
    remote.blobs.remove([plan.manifest.by_path["round_001/part 1.json"].sha256], published.token)
    with pytest.raises(NotFoundError):
        pull(url, remote, tmp_path / "got", unwatched)
    _, published = push(run, url, remote, silent)
    assert (published.uploaded, published.size, published.removed) == (1, 100, 0)
    pull(url, remote, tmp_path / "got", unwatched)
    assert content(tmp_path / "got") == content(run)


@pytest.fixture
def versions(tmp_path: Path, spec: RobotTaskSpec, make_episode: Callable[..., Episode]) -> list[Path]:
    """A dataset, a data file an episode, and the same with one episode more."""
    for count in (4, 5):
        write_dataset(
            [make_episode(seed) for seed in range(count)],
            tmp_path / f"d{count}",
            spec,
            repo_id="local/d",
            fingerprint={},
            data_files_size_in_mb=1e-6,
        )
    return [tmp_path / "d4", tmp_path / "d5"]


def _changed(versions: list[Path]) -> dict[str, int]:
    """Files of the second version that the first has not, or not so, and their sizes [bytes]."""
    old, new = map(content, versions)
    return {name: len(data) for name, data in new.items() if old.get(name) != data}


def test_one_more_episode_sends_only_the_files_that_it_changes(
    place: str, tmp_path: Path, versions: list[Path]
) -> None:
    changed = _changed(versions)
    files = {name for name in content(versions[1]) if name.startswith("data/")}
    assert len(files) == 5
    assert len(files & changed.keys()) == 1  # the new episode's own: those of the others travel no more
    url, remote = impatient(place)
    push(versions[0], url, remote, silent)
    plan, published = push(versions[1], url, remote, silent)
    assert set(plan.upload) == changed.keys()
    assert (published.uploaded, published.size) == (len(changed), sum(changed.values()))
    assert published.kept == len(content(versions[1])) - len(changed)
    pull(url, remote, tmp_path / "got", silent)
    assert content(tmp_path / "got") == content(versions[1])


def test_the_server_sees_no_more_bytes_than_one_more_episode_needs(
    proxy: Proxy, bucket: str, versions: list[Path]
) -> None:
    url, remote = impatient(f"s3://{bucket}/demos")
    push(versions[0], url, remote, silent)
    proxy.log.clear()
    push(versions[1], url, remote, silent)
    *sent, last = proxy.requests("^PUT ")
    assert "manip_il_manifest" in last.path
    assert sorted(one.received for one in sent) == sorted(_changed(versions).values())
    assert len(proxy.requests("^GET ")) <= 2


def test_what_the_version_before_had_is_there_until_the_next_push(tmp_path: Path) -> None:
    store = tmp_path / "store"
    url, remote = impatient(f"file://{store}")
    first = None
    for seed in (1, 2, 3):
        push(make_run(tmp_path / f"run{seed}", seed), url, remote, silent)
        if seed == 1:
            first = remote.read()
        stored = {path.name for path in (store / "objects").glob("*/*")}
        versions = [scan(tmp_path / f"run{n}", "policy").manifest.keys for n in range(max(1, seed - 1), seed + 1)]
        assert stored == set().union(*versions)
    with pytest.raises(NotFoundError):
        remote.fetch(first, first.manifest.by_path["config.yaml"], (tmp_path / "x").open("wb"), 0)


def test_two_pushes_at_once_one_wins(place: str, tmp_path: Path) -> None:
    runs = [make_run(tmp_path / f"run{n}", n) for n in range(3)]
    url, remote = impatient(place)
    push(runs[2], url, remote, silent)
    ready, outcomes = threading.Barrier(2), dict[int, str]()

    def one(number: int) -> None:
        _, remote = impatient(place)
        scanned, before = scan(runs[number], "policy"), remote.read()
        ready.wait()
        try:
            remote.publish(scanned.local, scanned.manifest, before, lambda _: None)
            outcomes[number] = "won"
        except ConflictError as error:
            outcomes[number] = str(error)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, range(2)))
    (winner,) = [number for number, outcome in outcomes.items() if outcome == "won"]
    assert "was changed by another push in the meantime" in outcomes[1 - winner]
    assert remote.warnings == ()
    pull(url, remote, tmp_path / "got", silent)
    assert content(tmp_path / "got") == content(runs[winner])
    push(runs[1 - winner], url, remote, silent)  # the loser, told to try again
    pull(url, remote, tmp_path / "got2", silent)
    assert content(tmp_path / "got2") == content(runs[1 - winner])


def test_two_first_pushes_at_once_one_wins(place: str, tmp_path: Path) -> None:
    runs = [make_run(tmp_path / f"run{n}", n) for n in range(2)]
    url, remote = impatient(place)
    push(runs[0], url, remote, silent)
    scanned = scan(runs[1], "policy")
    with pytest.raises(ConflictError):
        remote.publish(scanned.local, scanned.manifest, None, lambda _: None)
    pull(url, remote, tmp_path / "got", silent)
    assert content(tmp_path / "got") == content(runs[0])


def test_readers_never_see_a_mix(place: str, tmp_path: Path) -> None:
    runs = [make_run(tmp_path / f"run{n}", n) for n in range(2)]
    versions = [content(run) for run in runs]
    url, remote = impatient(place)
    push(runs[0], url, remote, silent)
    over = threading.Event()

    def write() -> None:
        url, remote = impatient(place)
        for number in range(1, 5):
            push(runs[number % 2], url, remote, silent)
        over.set()

    writer = threading.Thread(target=write)
    writer.start()
    count = 0
    while not over.is_set() and count < 50:
        count += 1
        pull(url, remote, tmp_path / f"got{count}", unwatched)
        assert content(tmp_path / f"got{count}") in versions
        shutil.rmtree(tmp_path / f"got{count}")
    writer.join()
    assert count > 1


def test_a_pull_replaces_in_one_step_when_asked(tmp_path: Path) -> None:
    run, target = make_run(tmp_path / "run", 1), make_run(tmp_path / "got", 2)
    before = content(target)
    url, remote = impatient(f"file://{tmp_path}/store")
    push(run, url, remote, silent)
    with pytest.raises(FolderExistsError):
        pull(url, remote, target, silent)
    assert content(target) == before
    pull(url, remote, target, silent, overwrite=True)
    assert content(target) == content(run)


def test_dry_runs_change_nothing(place: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    url, remote = impatient(place)
    plan, published = push(run, url, remote, silent, dry_run=True)
    assert published is None
    assert len(plan.upload) == len(content(run)) - 1
    assert remote.read() is None
    push(run, url, remote, silent)
    pull(url, remote, tmp_path / "got", silent, dry_run=True)
    assert not (tmp_path / "got").exists()


def test_a_dataset_that_is_not_whole_is_refused_in_a_run_too(tmp_path: Path, dataset: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    inside = run / "round_000" / "dataset"
    shutil.copytree(dataset, inside)
    url, remote = impatient(f"file://{tmp_path}/store")
    push(run, url, remote, silent)
    (inside / TASKS).unlink()
    with pytest.raises(NotWhole, match=r"round_000/dataset is damaged and was not pushed"):
        push(run, url, remote, silent)
    url, remote = impatient(f"file://{tmp_path}/other")
    with pytest.raises(NotWhole, match=r"damaged and was not pushed: .*tasks.parquet.*manip-il doctor"):
        push(inside, url, remote, silent)
    assert not (tmp_path / "other").exists()


def test_a_place_that_holds_another_kind_or_other_files_is_refused(place: str, tmp_path: Path, dataset: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    url, remote = impatient(place)
    push(run, url, remote, silent)
    with pytest.raises(UsageError, match="holds a policy; a dataset cannot replace it: choose another name"):
        push(dataset, url, remote, silent)
    url, remote = impatient(place.rpartition("/")[0])
    with pytest.raises(UsageError, match="holds other files"):
        push(run, url, remote, silent)


@pytest.mark.parametrize("name", ["policy.pt", "weights.bin", "a.pkl", "run.py", "go.sh", "a link.json"])
def test_pickles_code_and_links_are_not_pushed(name: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    (run / name).symlink_to("/etc/passwd") if "link" in name else (run / name).write_bytes(b"x")
    with pytest.raises(ManifestError, match="is a link" if "link" in name else name):
        scan(run, "policy")


def test_leftovers_stay_at_home(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 1)
    wanted = scan(run, "policy").manifest
    for name in (".git/config", ".x.partial", "a.partial", ".metrics.tmp", "journals/episode.mcap"):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_text("x")
    assert scan(run, "policy").manifest == wanted
    assert "journals/episode.mcap" in scan(run, "policy", journals=True).manifest.by_path
