"""Processes that share every batch of a fit: each takes its part of it, and torch averages their gradients."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import warnings
from collections.abc import Callable, Iterator, Mapping
from multiprocessing import get_context

import torch
from accelerate.state import AcceleratorState

from manip_il.child_processes import end_with_parent
from manip_il.errors import ManipError

_RANK = "RANK"  # set where several processes were started by `accelerate launch` or `torchrun`
_HOST = "127.0.0.1"
_DYING = 2.0  # from a process's last connection to its exit code, at most [s]


@contextlib.contextmanager
def sharing_batches(count: int, threads: int, work: Callable[[], object]) -> Iterator[None]:
    """Run `work` in `count` - 1 processes more, while this one does the same inside, as the first.

    threads: of torch, in each. Processes that somebody else has started are left alone. Raises `ManipError` where one
    dies.
    """
    if count == 1 or _RANK in os.environ:
        yield
        return
    places = [_place(rank, count, threads) for rank in range(count)]
    port = {"MASTER_PORT": str(_free_port())}
    context = get_context("spawn")
    others = [context.Process(target=_serve, args=(place | port, work), daemon=True) for place in places[1:]]
    with _environment(places[0] | port), warnings.catch_warnings():
        _ignore_strides()
        try:
            for other in others:
                other.start()
            yield
            for other in others:
                other.join()
        except RuntimeError as error:  # gloo's, where the other end of a connection is gone
            for other in others:
                other.join(_DYING)
            if any(other.exitcode for other in others):
                raise ManipError("a process that shares the batches died (out of memory?)") from error
            raise
        finally:
            for other in others:
                if other.is_alive():
                    other.terminate()
                other.join()
            _leave()


def _place(rank: int, count: int, threads: int) -> dict[str, str]:
    """The variables by which torch and accelerate find the others."""
    numbers = {_RANK: rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count}
    return {name: str(value) for name, value in (numbers | {"OMP_NUM_THREADS": threads}).items()} | {
        "MASTER_ADDR": _HOST
    }


def _free_port() -> int:
    with socket.socket() as one:
        one.bind((_HOST, 0))
        return one.getsockname()[1]


@contextlib.contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(variables: Mapping[str, str], work: Callable[[], object]) -> None:
    os.environ.update(variables)
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _ignore_strides()
    with open(os.devnull, "w", encoding="utf-8") as nothing, contextlib.redirect_stdout(nothing):
        work()


def _ignore_strides() -> None:
    """Convolutions on a CPU give gradients whose channels come last: torch warns that it copies them."""
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")


def _leave() -> None:
    """Leave the others, so that the next fit may have none, or others."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
    forget_earlier_fits()


def forget_earlier_fits() -> None:
    """Let the next fit of this process choose its own precision: accelerate keeps that of the first."""
    if not torch.distributed.is_initialized():
        AcceleratorState._reset_state(reset_partial_state=True)  # pyright: ignore[reportPrivateUsage]
