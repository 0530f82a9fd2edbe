# hilctl for recordings and simulations, and its continuous integration.
#   docker build --target hilctl --tag hilctl .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" hilctl report run.mcap --html run.html
#   docker build --target ci --tag hilctl-ci . && docker run --rm --shm-size=1g hilctl-ci
# Run real devices on the machine itself: docs/howto/install.md.

FROM python:3.11-slim-bookworm AS build
RUN apt-get update && apt-get install --yes --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
RUN python -m venv /opt/hilctl
COPY requirements/core.txt /src/
RUN /opt/hilctl/bin/pip install --no-cache-dir --require-hashes --requirement /src/core.txt
COPY . /src
RUN /opt/hilctl/bin/pip install --no-cache-dir --no-deps --no-build-isolation /src

FROM python:3.11-slim-bookworm AS hilctl
COPY --from=build /opt/hilctl /opt/hilctl
# The user has no home there: compiled kernels and fonts are stored in folders that all users can write.
ENV PATH=/opt/hilctl/bin:$PATH NUMBA_CACHE_DIR=/tmp/kernels MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /work
ENTRYPOINT ["hilctl"]
CMD ["--help"]

FROM python:3.11-bookworm AS ci
COPY . /src
WORKDIR /src
CMD [".ci/run"]
