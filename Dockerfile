# Three images of one program; the first word after `sitegrid` decides what runs (compose.yaml):
#   docker build --target agent    a machine's computer
#   docker build --target server   router, map server, follower, page
#   docker build --target sim      a simulated site
FROM python:3.11-slim AS build
WORKDIR /build
RUN python3 -m venv --without-pip /venv
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY protocol protocol
COPY agents agents
COPY mapserver mapserver
COPY sim sim
COPY sitegrid sitegrid
# What is not needed is removed where it is installed, so that no layer of an image has it; bytecode is of what is used.
ENV INSTALL="python3 -m pip --python /venv/bin/python install --quiet --no-cache-dir --no-compile --constraint constraints.txt"

FROM build AS build-agent
RUN $INSTALL ".[agent,can,receivers,security]"
WORKDIR /venv/lib/python3.11/site-packages
# An agent uses SciPy's linear algebra alone.
RUN find . -type d -name tests -prune -exec rm -r {} + \
    && find scipy -mindepth 1 -maxdepth 1 -type d ! -name linalg ! -name _lib -exec rm -r {} + \
    && /venv/bin/python -c "import agents.agent, agents.drivers.zenoh, sitegrid.command_line"

FROM build AS build-server
RUN $INSTALL ".[postgres,security,server,web]" pyogrio shapely
WORKDIR /venv/lib/python3.11/site-packages
RUN find . -type d -name tests -prune -exec rm -r {} + \
    && rm -r pyarrow/include pyarrow/*flight* pyarrow/_substrait* pyarrow/*_s3* \
    pyarrow/libarrow_python.so pyarrow/libarrow_python.so.*.*.* \
    scipy/integrate scipy/interpolate scipy/io scipy/signal scipy/stats \
    && find mapserver -name "*.py" -exec touch --date=2026-01-01 {} +
# Numba compares the time of a kernel's source, and a registry keeps whole seconds alone.
# Kernels for any processor of this kind: one that differs from the builder's would compile them anew.
ENV NUMBA_CPU_NAME=generic
RUN NUMBA_CACHE_DIR=/kernels /venv/bin/python -c \
    "import pyarrow.parquet, mapserver.follower.follower, mapserver.monitoring.metrics; \
    import sitegrid.command_line, sitegrid.web.process; \
    from mapserver import config, server; server.warm_up(config.ServerConfig()); \
    list(server.warm_up_rest(config.ServerConfig()))"

FROM build AS build-sim
RUN $INSTALL ".[sim]"
WORKDIR /venv/lib/python3.11/site-packages
RUN find . -type d -name tests -prune -exec rm -r {} + \
    && rm -r pybullet_data \
    && /venv/bin/python -c "import sim.simulator, sitegrid.command_line"

FROM python:3.11-slim AS base
RUN useradd --uid 10001 --create-home sitegrid \
    && install --directory --owner sitegrid --group sitegrid /data
WORKDIR /opt/sitegrid
COPY config config
ENV PATH=/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/tmp/numba
LABEL org.opencontainers.image.version="0.2.0" \
    org.opencontainers.image.licenses="MIT"
USER 10001
VOLUME /data
ENTRYPOINT ["sitegrid"]
CMD ["--help"]

FROM base AS agent
COPY --from=build-agent /venv /venv
LABEL org.opencontainers.image.title="sitegrid agent"

FROM base AS sim
COPY --from=build-sim /venv /venv
LABEL org.opencontainers.image.title="sitegrid simulator"

FROM base AS server
COPY --from=build-server /venv /venv
COPY --from=build-server /kernels /opt/kernels
ENV NUMBA_CPU_NAME=generic
LABEL org.opencontainers.image.title="sitegrid server"
# Numba wants to write where it reads kernels, and the root file system may be read-only.
ENTRYPOINT ["sh", "-c", "cp -R /opt/kernels/. /tmp/numba && exec sitegrid \"$@\"", "sitegrid"]
