"""Push and pull over loopback against the plain client's copy: 1,000 small files, and one large one.

python benchmarks/remote_speed.py [--quick]

Ours hashes, verifies, syncs and switches over in one step; the plain client only copies: shutil.copytree for file://,
s3fs' put and get for s3:// (moto), paramiko's put and get for sftp:// (Debian's sshd, which must be installed). By
turns in the same run, into new places each time; the median ratio of the repeats counts (above 1: ours is faster).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import boto3
import paramiko
from _machine import describe_machine
from s3fs import S3FileSystem

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "data" / "remote"))
from s3 import KEY, SECRET, running_moto, variables  # pyright: ignore[reportMissingImports]
from sshd import Sshd, running_sshd  # pyright: ignore[reportMissingImports]

from manip_il.data.remote.pull import pull
from manip_il.data.remote.push import push
from manip_il.data.remote.url import RemoteUrl, open_remote

BUCKET = "benchmark"


@dataclass(frozen=True)
class Store:
    """A kind of store, and what its plain client does: put a folder at a place, get it back."""

    name: str
    url: Callable[[str], str]
    put: Callable[[Path, str], object]
    get: Callable[[str, Path], object]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of everything, once")
    options = parser.parse_args()
    repeats, tenth = (1, 10) if options.quick else (3, 1)
    print(describe_machine())
    print("store  files            push: plain [s]  ours [s]  ratio    pull: plain [s]  ours [s]  ratio")
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="remote_speed_")))
        os.environ |= variables(stack.enter_context(running_moto()))
        server = stack.enter_context(running_sshd(_made(folder / "sshd")))
        os.environ["HOME"] = str(server.home)
        trees = {
            f"{1000 // tenth:,} of 10 kB": make_tree(folder / "small", 1000 // tenth, 10_000),
            f"1 of {1000 // tenth} MB": make_tree(folder / "large", 1, 10**9 // tenth),
        }
        for store in stores(folder, server):
            for name, tree in trees.items():
                measure(store, name, tree, folder / "work", repeats)
    return 0


def measure(store: Store, name: str, tree: Path, work: Path, repeats: int) -> None:
    times: dict[str, list[float]] = {"plain put": [], "put": [], "plain get": [], "get": []}
    for number in range(repeats + 1):
        place, plain = f"{work}/{number}/ours", f"{work}/{number}/plain"
        Path(place).parent.mkdir(parents=True)
        url = RemoteUrl.parse(store.url(place))
        for what, step in {
            "plain put": lambda plain=plain: store.put(tree, plain),
            "put": lambda url=url: push(tree, url, open_remote(url), unwatched),
            "plain get": lambda plain=plain, number=number: store.get(plain, work / f"{number}" / "got plain"),
            "get": lambda url=url, number=number: pull(url, open_remote(url), work / f"{number}" / "got", unwatched),
        }.items():
            start = time.perf_counter()
            step()
            if number:  # the first turn warms up
                times[what].append(time.perf_counter() - start)
        shutil.rmtree(work / f"{number}")
    shutil.rmtree(work)
    row = f"{store.name:6} {name:16}"
    for what in ("put", "get"):
        plain, ours = times[f"plain {what}"], times[what]
        ratio = statistics.median(a / b for a, b in zip(plain, ours, strict=True))
        row += f" {statistics.median(plain):14.2f} {statistics.median(ours):9.2f} {ratio:6.2f}   "
    print(row, flush=True)


def stores(folder: Path, server: Sshd) -> list[Store]:
    client = boto3.client("s3", aws_access_key_id=KEY, aws_secret_access_key=SECRET)
    client.create_bucket(Bucket=BUCKET)

    def s3_put(tree: Path, place: str) -> None:
        S3FileSystem(skip_instance_cache=True).put(str(tree), f"{BUCKET}{place}", recursive=True)

    def s3_get(place: str, target: Path) -> None:
        S3FileSystem(skip_instance_cache=True).get(f"{BUCKET}{place}", str(target), recursive=True)

    def sftp_put(tree: Path, place: str) -> None:
        with connected(server) as sftp:
            sftp.mkdir(place)
            for path in tree.iterdir():
                sftp.put(str(path), f"{place}/{path.name}")

    def sftp_get(place: str, target: Path) -> None:
        target.mkdir()
        with connected(server) as sftp:
            for name in sftp.listdir(place):
                sftp.get(f"{place}/{name}", str(target / name))

    return [
        Store("file", lambda place: f"file://{place}", shutil.copytree, shutil.copytree),
        Store("s3", lambda place: f"s3://{BUCKET}{place}", s3_put, s3_get),
        Store("sftp", lambda place: server.url(Path(place)), sftp_put, sftp_get),
    ]


@contextlib.contextmanager
def connected(server: Sshd):
    client = paramiko.SSHClient()
    client.load_system_host_keys()
    key = str(server.home.parent / "user_key")
    client.connect("127.0.0.1", server.port, server.user, key_filename=key)
    with client, client.open_sftp() as sftp:
        yield sftp


def make_tree(folder: Path, files: int, size: int) -> Path:
    """A folder that counts as a run."""
    _made(folder)
    (folder / "config.yaml").write_text("# manip-il\n")
    for number in range(files):
        (folder / f"{number}.json").write_bytes(os.urandom(size))
    return folder


def unwatched(total: int, what: str) -> contextlib.AbstractContextManager[Callable[[int], None]]:
    return contextlib.nullcontext(lambda _: None)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


if __name__ == "__main__":
    sys.exit(main())
