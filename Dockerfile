# The command line as an image: `docker build -t manip-il .`; docs/docker.md shows how to use it. Before version 23,
# Docker needs DOCKER_BUILDKIT=1.

FROM debian:trixie-slim AS uv
ARG UV_VERSION=0.13.8
# The base image may trust certificates of its own; uv trusts them, too.
ENV UV_SYSTEM_CERTS=true UV_PYTHON_DOWNLOADS=never UV_NO_CACHE=true
RUN apt-get update -qq \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends ca-certificates python3-venv \
    && apt-get clean && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/uv \
    && /opt/uv/bin/pip install --quiet --no-cache-dir --disable-pip-version-check "uv==$UV_VERSION"
WORKDIR /build

# The lock holds the developers' tools as well: here are the names and versions that running needs. Left out: cmake,
# which LeRobot names and never calls, and triton, which is of no use without a C compiler.
# TORCH_BACKEND, empty: PyTorch with CUDA, as locked; cpu: from PyTorch's own index, of whose files the lock has no hashes.
FROM uv AS names
ARG TORCH_BACKEND=
COPY pyproject.toml requirements.lock ./
RUN /opt/uv/bin/uv pip compile --quiet --no-header --no-annotate --python /usr/bin/python3 \
        ${TORCH_BACKEND:+--torch-backend=$TORCH_BACKEND} --no-emit-package cmake --no-emit-package triton \
        --extra rl --extra sharing --extra so101 --constraints requirements.lock pyproject.toml --output-file runtime.txt

FROM debian:trixie-slim
LABEL org.opencontainers.image.title="manip-il" \
      org.opencontainers.image.description="Robot-arm imitation learning without a human at the controls" \
      org.opencontainers.image.version="1.0.0" \
      org.opencontainers.image.licenses="Apache-2.0"
# OpenGL without a graphics card (Mesa), and FFmpeg's libraries for torchcodec.
RUN apt-get update -qq \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        python3 libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 ffmpeg \
    && apt-get clean && rm -rf /var/lib/apt/lists/*
# NVIDIA's container toolkit brings the driver of a GPU, not always the word to libEGL that it is there. Tried before
# Mesa's, and passed over where there is no such driver.
RUN echo '{"file_format_version": "1.0.0", "ICD": {"library_path": "libEGL_nvidia.so.0"}}' \
        >/usr/share/glvnd/egl_vendor.d/10_nvidia.json

# Those packages with the lock's hashes; one that the lock has not ends the build. Tests and headers go again. uv and its
# certificates are only mounted: the packages are written once, and nothing else of that stage is in the image.
ARG TORCH_BACKEND=
RUN --mount=from=uv,source=/opt/uv,target=/opt/uv --mount=from=uv,source=/etc/ssl,target=/etc/ssl \
    --mount=from=names,source=/build,target=/build \
    export UV_SYSTEM_CERTS=true UV_NO_CACHE=true \
    && /opt/uv/bin/uv venv --quiet --python /usr/bin/python3 /opt/manip-il \
    && /opt/uv/bin/uv pip install --quiet --no-deps --compile-bytecode --python /opt/manip-il/bin/python \
        $(if [ "$TORCH_BACKEND" ]; then echo "--no-verify-hashes --torch-backend=$TORCH_BACKEND"; \
          else echo --require-hashes; fi) \
        --constraints /build/requirements.lock --requirements /build/runtime.txt \
    && cd /opt/manip-il/lib/python3*/site-packages && rm -r torch/include \
    && find pandas pyarrow scipy sympy -type d -name tests -prune -exec rm -r {} +

# This project alone: a change of its code leaves the packages as they are.
RUN --mount=from=uv,source=/opt/uv,target=/opt/uv --mount=target=/src,rw \
    /opt/uv/bin/uv pip install --quiet --no-cache --offline --no-deps --no-build-isolation --compile-bytecode \
        --python /opt/manip-il/bin/python /src /src/plugin
WORKDIR /opt/manip-il/share/manip_il
COPY configs configs
# Everything that is written goes under /tmp, so that the root may be read-only and the user anyone, even one without a
# name (USER answers in its place).
ENV PATH=/opt/manip-il/bin:$PATH \
    MUJOCO_GL=egl \
    NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility \
    PYTHONUNBUFFERED=1 \
    USER=manip \
    HOME=/tmp \
    XDG_CACHE_HOME=/tmp/cache \
    HF_HOME=/tmp/cache/huggingface \
    TORCHINDUCTOR_CACHE_DIR=/tmp/cache/torchinductor \
    MPLCONFIGDIR=/tmp/cache/matplotlib
USER 1000:1000
# An interrupted command says what it has kept and how to go on.
STOPSIGNAL SIGINT
HEALTHCHECK --interval=10m --timeout=2m CMD ["manip-il", "eval", "--check"]
ENTRYPOINT ["manip-il"]
CMD ["--help"]
