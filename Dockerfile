# hadolint global ignore=DL3008
# (Debian's packages are not pinned: Debian drops old versions, and a pinned one would soon fail to install.)
#
# The image contains the wheel of this checkout and can draw without a screen. docs/install.md shows how to use the image.
#   CPU and CUDA:      docker build -t bidex-meta .
#   CPU only, smaller: docker build -t bidex-meta --build-arg TORCH_INDEX=URL .   (PyTorch's index of CPU builds)

# This is debian:bookworm-slim of 3 August 2026, which has Python 3.11. `docker buildx imagetools inspect
# debian:bookworm-slim` prints the digest of a newer image.
ARG BASE=debian:bookworm-slim@sha256:abd67ffcfa541b485a3dff59865ab629aa048a6c613e639d36e7456b0b229241

FROM ${BASE} AS build
RUN apt-get update && apt-get install --yes --no-install-recommends python3-venv
RUN python3 -m venv /opt/bidex-meta
WORKDIR /src
COPY constraints.txt .
# torch is installed first, as in the Makefile. The index decides between the builds for CPUs and for CUDA.
ARG TORCH_INDEX=
RUN /opt/bidex-meta/bin/pip install --no-cache-dir --no-deps ${TORCH_INDEX:+--index-url "${TORCH_INDEX}"} \
    -c constraints.txt torch
COPY . .
ARG EXTRAS=video
RUN /opt/bidex-meta/bin/pip install --no-cache-dir -c constraints.txt ".[${EXTRAS}]"

FROM ${BASE}
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1 libosmesa6 python3 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 bidex \
    && chmod 1777 /home/bidex
COPY --from=build /opt/bidex-meta /opt/bidex-meta
# Any user may run the image (`docker run --user`), so the home folder, with its caches, is set here and writable for all.
ENV HOME=/home/bidex \
    USER=bidex \
    PATH=/opt/bidex-meta/bin:${PATH} \
    NVIDIA_DRIVER_CAPABILITIES=all
USER 1000
WORKDIR /home/bidex
ENTRYPOINT ["bidex-meta"]
