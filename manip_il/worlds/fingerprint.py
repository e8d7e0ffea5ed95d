"""Versions and hashes that determine the bytes that an environment computes."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from numpy._core._multiarray_umath import (
    __cpu_features__,
)  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]
from threadpoolctl import threadpool_info

_CPU_INFO = Path("/proc/cpuinfo")
# x86_64, then aarch64
_CPU_NAMES = ("vendor_id", "cpu family", "model", "CPU implementer", "CPU part")
_SECOND_CACHE = Path("/sys/devices/system/cpu/cpu0/cache/index2/size")
_PACKAGES = ("manip_il", "mujoco", "mink", "lerobot", "torch", "numpy")


def environment_fingerprint(model_bytes: bytes, config: Mapping[str, Any]) -> dict[str, str]:
    """Return versions of packages, the processor, and SHA-256 hashes of the compiled model and the
    config.

    Environments with equal fingerprints compute equal bytes. The versions are read without
    importing the packages.
    """
    versions = {name: metadata.version(name) for name in _PACKAGES}
    return {
        "python": platform.python_version(),
        **versions,
        "processor": processor(),
        "model_sha256": hashlib.sha256(model_bytes).hexdigest(),
        "config_sha256": hashlib.sha256(canonical_json(config).encode()).hexdigest(),
    }


@functools.cache
def processor() -> str:
    """Return what affects the last bits of float arithmetic.

    Its maker, family and model, because libraries choose other code for other makers with the same
    vector extensions; the size of its second cache, after which BLAS divides matrices; vector
    extensions, BLAS and its kernels, and the C library. For example `x86_64 GenuineIntel 6 106
    1280K AVX512_ICL, openblas 0.3.29 SkylakeX, glibc 2.36`.
    """
    extensions = [name for name, found in __cpu_features__.items() if found]
    libraries = [one for one in threadpool_info() if one["user_api"] == "blas"]
    # Other packages may have loaded their own BLAS into this process.
    numpys = [one for one in libraries if "numpy" in one["filepath"]] or libraries or [{}]
    blas = " ".join(
        str(numpys[0].get(key, "")) for key in ("internal_api", "version", "architecture")
    )
    made = [platform.machine(), *_model(), *extensions[-1:]]
    return f"{' '.join(made)}, {blas}, {' '.join(platform.libc_ver())}"


def _model() -> list[str]:
    """The processor's maker, family, model and size of its second cache, as far as Linux says
    them.
    """
    words: dict[str, str] = {}
    with contextlib.suppress(OSError):
        for line in _CPU_INFO.read_text().splitlines():
            name, _, value = line.partition(":")
            words.setdefault(name.strip(), value.strip())
    found = [words[name] for name in _CPU_NAMES if name in words]
    with contextlib.suppress(OSError):
        found.append(_SECOND_CACHE.read_text().strip())
    return found


def canonical_json(value: Any) -> str:
    """Return JSON with sorted keys and no spaces, so that equal configs give equal text.

    Also takes dataclasses. Raises `TypeError` for anything else.
    """
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), allow_nan=False, default=dataclasses.asdict
    )
