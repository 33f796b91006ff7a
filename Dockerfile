<<<<<<< HEAD
# octoreplay in a slim image, run by an unprivileged user:
#   docker build -t octoreplay .
#   docker run --rm -v "$PWD:/data" --user "$(id -u):$(id -g)" octoreplay run team.yaml -o result.mcap

FROM python:3.12-slim-bookworm AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN python -m venv /opt/octoreplay && /opt/octoreplay/bin/pip install --no-cache-dir .

FROM python:3.12-slim-bookworm
# Shared libraries that Open3D loads; it renders without a display.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1 libgomp1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/octoreplay /opt/octoreplay
# Compiled kernels are kept in a folder that any user may write to.
RUN useradd --create-home --uid 1000 octoreplay && mkdir --mode=1777 /var/cache/octoreplay
ENV PATH=/opt/octoreplay/bin:$PATH NUMBA_CACHE_DIR=/var/cache/octoreplay MPLCONFIGDIR=/tmp/matplotlib
=======
# docker build -t octoreplay .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" octoreplay run team.yaml -o result.mcap
FROM python:3.12-slim-bookworm AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY src ./src
RUN python -m venv /opt/octoreplay \
    && /opt/octoreplay/bin/pip install --no-cache-dir --disable-pip-version-check .

FROM python:3.12-slim-bookworm
# Open3D loads these libraries when it is imported.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgomp1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 octoreplay
COPY --from=build /opt/octoreplay /opt/octoreplay
ENV PATH=/opt/octoreplay/bin:$PATH \
    MPLCONFIGDIR=/tmp/matplotlib \
    XDG_CACHE_HOME=/tmp/cache
>>>>>>> main
USER 1000
WORKDIR /data
ENTRYPOINT ["octoreplay"]
CMD ["--help"]
