# The command in a container, without a compiler and not as root:
#   docker build -t scanweave .
#   docker run --rm -v "$PWD:/data" scanweave demo
#   docker run --rm -v "$PWD:/data" scanweave map monday.log -o house
# As the owner of the folder: docker run --user "$(id -u):$(id -g)" ...
# Kernels are compiled while it is built; what another processor compiles is kept by: docker run -v scanweave-numba:/tmp/numba ...
# On another base that has `python` and its venv: docker build --build-arg BASE=... (podman, buildah: the same).
ARG BASE=python:3.13-slim
FROM ${BASE} AS build
WORKDIR /src
COPY requirements.lock .
RUN python -m venv /venv && /venv/bin/pip install --no-cache-dir --require-hashes --requirement requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY configs configs
COPY fusion fusion
COPY slam slam
RUN /venv/bin/pip install --no-cache-dir --no-deps .

FROM ${BASE}
# What Numba compiles and Matplotlib finds is kept where any user may write.
ENV PATH=/venv/bin:$PATH NUMBA_CACHE_DIR=/tmp/numba MPLCONFIGDIR=/tmp/matplotlib
COPY --from=build /venv /venv
RUN useradd --create-home scanweave && mkdir /data && chown scanweave /data && mkdir --mode 1777 /tmp/numba
USER scanweave
WORKDIR /data
# Else each container would compile them. On ARM, where nothing is simulated, each still does.
RUN scanweave demo --out /tmp/demo; rm -rf /tmp/demo /tmp/matplotlib; find /tmp/numba -mindepth 1 -exec chmod a+rwX {} +
ENTRYPOINT ["scanweave"]
CMD ["--help"]
