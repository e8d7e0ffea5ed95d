"""Push and pull over loopback against copying with the plain client: 1,000 small files, and one
large one.

python benchmarks/remote_speed.py [--quick] [--repeats N] [--stores file,sftp,hub,s3]

Ours hashes, verifies and commits atomically; the plain client only copies: shutil.copytree for
file://; paramiko's put and get for sftp:// (Debian's sshd, which must be installed);
huggingface_hub's upload_folder and snapshot_download for hf:// (the tests' server); s3fs' put and
get for s3:// (moto, in a process of its own). Both alternate in the same run, into new places each
time; the result is the median ratio (above 1: ours is faster).

ratio: of the commands' times; our pull ends when all data are on disk, the plain client's when they
are in memory. on disk: of the times until all data are on this machine's disk.
"""

import argparse
import contextlib
import getpass
import multiprocessing
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import huggingface_hub
import paramiko
from _machine import describe_machine
from huggingface_hub.utils import disable_progress_bars
from s3fs import S3FileSystem

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from manip_il.bridges.store.transfer import open_remote, pull, push
from tests.store.servers import TOKEN, Hub, Sshd, hub_server, s3_server, sshd_server, talk_to

BUCKET = "benchmark"


@dataclass(frozen=True)
class Store:
    """A kind of store and its plain client. put: copies a folder to a place in the store.

    get: copies it back.
    """

    name: str
    url: Callable[[str], str]
    put: Callable[[Path, str], object]
    get: Callable[[str, Path], object]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of everything, once")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--stores", default="file,sftp,hub,s3")
    options = parser.parse_args()
    repeats, tenth = (1, 10) if options.quick else (options.repeats, 1)
    print(describe_machine())
    columns = "plain [s]  ours [s]  ratio  on disk"
    print(f"store     files            push: {columns}    pull: {columns}")
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="remote_speed_")))
        os.environ |= stack.enter_context(moto_beside())
        server = stack.enter_context(sshd_server(_made(folder / "sshd")))
        os.environ["HOME"] = str(server.home)
        hub = stack.enter_context(hub_server())
        warm = make_tree(folder / "warm", 10, 10_000, "json")
        trees = {
            f"{1000 // tenth:,} of 10 kB": make_tree(
                folder / "small", 1000 // tenth, 10_000, "json"
            ),
            f"1 of {1000 // tenth} MB": make_tree(
                folder / "large", 1, 10**9 // tenth, "safetensors"
            ),
        }
        for store in stores(server, hub):
            if store.name not in options.stores.split(","):
                continue
            turn(store, warm, folder / f"{store.name}_warm")
            for number, (name, tree) in enumerate(trees.items()):
                places = [folder / f"{store.name}_{number}_{repeat}" for repeat in range(repeats)]
                turns = [
                    turn(store, tree, place, ours_first=bool(n % 2))
                    for n, place in enumerate(places)
                ]
                show(f"{store.name:9} {name:16}", turns)
    return 0


def turn(store: Store, tree: Path, work: Path, *, ours_first: bool = False) -> dict[str, float]:
    """Return the seconds of each direction, plain and ours.

    ours_first: alternates between turns, because the first one has more free memory.
    """
    times: dict[str, float] = {}
    place, plain = f"{_made(work)}/ours", f"{work}/plain"
    url = store.url(place)
    steps = {
        "plain push": lambda: store.put(tree, plain),
        "push": lambda: push(tree, open_remote(url, quiet=True)),
        "plain pull": lambda: store.get(plain, work / "got plain"),
        "pull": lambda: pull(open_remote(url, quiet=True), work / "got"),
    }
    order = ("push", "plain push", "pull", "plain pull") if ours_first else tuple(steps)
    for what in order:
        os.sync()
        start = time.perf_counter()
        steps[what]()
        times[what] = time.perf_counter() - start
        os.sync()
        times[f"{what} on disk"] = time.perf_counter() - start
    shutil.rmtree(work)
    return times


def show(row: str, turns: list[dict[str, float]]) -> None:
    for what in ("push", "pull"):
        for name in (f"plain {what}", what):
            row += f" {statistics.median(times[name] for times in turns):10.2f}"
        for end in ("", " on disk"):
            ratio = statistics.median(
                times[f"plain {what}{end}"] / times[f"{what}{end}"] for times in turns
            )
            row += f" {ratio:7.2f}"
        row += "   "
    print(row, flush=True)


@contextlib.contextmanager
def moto_beside() -> Iterator[dict[str, str]]:
    """Yield the variables of a server in another process.

    In this one it would compete for Python's global lock.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    server = context.Process(target=_serve_s3, args=(there,))
    server.start()
    try:
        yield here.recv()
    finally:
        here.send("stop")
        server.join()


def _serve_s3(parent: Connection) -> None:
    with s3_server(BUCKET) as variables:
        parent.send(variables)
        parent.recv()


def stores(server: Sshd, hub: Hub) -> list[Store]:
    def s3_put(tree: Path, place: str) -> None:
        S3FileSystem(skip_instance_cache=True).put(str(tree), f"{BUCKET}{place}", recursive=True)

    def s3_get(place: str, target: Path) -> None:
        S3FileSystem(skip_instance_cache=True).get(f"{BUCKET}{place}", str(target), recursive=True)

    def sftp_put(tree: Path, place: str) -> None:
        with connected(server) as client:
            client.mkdir(place)
            for path in tree.iterdir():
                client.put(str(path), f"{place}/{path.name}")

    def sftp_get(place: str, target: Path) -> None:
        target.mkdir()
        with connected(server) as client:
            for file in client.listdir(place):
                client.get(f"{place}/{file}", str(target / file))

    os.environ["HF_TOKEN"] = TOKEN
    talk_to(hub.url)
    disable_progress_bars()
    api = huggingface_hub.HfApi(endpoint=hub.url, token=TOKEN)

    def hub_put(tree: Path, place: str) -> None:
        api.create_repo(_repo(place))
        api.upload_folder(repo_id=_repo(place), folder_path=tree)

    def hub_get(place: str, target: Path) -> None:
        api.snapshot_download(_repo(place), local_dir=target)

    return [
        Store("file", lambda place: f"file://{place}", shutil.copytree, shutil.copytree),
        Store("sftp", lambda place: server.url(Path(place)), sftp_put, sftp_get),
        Store("hub", lambda place: f"hf://{_repo(place)}", hub_put, hub_get),
        Store("s3", lambda place: f"s3://{BUCKET}{place}", s3_put, s3_get),
    ]


def _repo(place: str) -> str:
    return "user/" + "_".join(Path(place).parts[-2:])


@contextlib.contextmanager
def connected(server: Sshd) -> Iterator[paramiko.SFTPClient]:
    client = paramiko.SSHClient()
    client.load_system_host_keys()
    key = str(server.home.parent / "user_key")
    client.connect("127.0.0.1", server.port, getpass.getuser(), key_filename=key)
    with client, client.open_sftp() as sftp:
        yield sftp


def make_tree(folder: Path, files: int, size: int, suffix: str) -> Path:
    """Create and return a folder that `push` takes for a run. size: of each file [bytes]."""
    _made(folder)
    (folder / "config.yaml").write_text("# manip-il\n")
    # its own card, so that none is generated
    (folder / "README.md").write_text("---\nlicense: mit\n---\n")
    for number in range(files):
        (folder / f"{number}.{suffix}").write_bytes(os.urandom(size))
    return folder


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


if __name__ == "__main__":
    sys.exit(main())
