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
USER 1000
WORKDIR /data
ENTRYPOINT ["octoreplay"]
CMD ["--help"]
