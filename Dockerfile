# One image for router, map server, page, agents and simulator: the first word after `sitegrid` decides (see compose.yaml).
FROM python:3.11-slim AS build
WORKDIR /build
RUN python -m venv /venv
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY protocol protocol
COPY agents agents
COPY mapserver mapserver
COPY sim sim
COPY sitegrid sitegrid
RUN /venv/bin/pip install --no-cache-dir --disable-pip-version-check \
    --constraint constraints.txt ".[demo,postgres,security]"

FROM python:3.11-slim
RUN useradd --uid 10001 --create-home sitegrid \
    && install --directory --owner sitegrid --group sitegrid /data
COPY --from=build /venv /venv
WORKDIR /opt/sitegrid
COPY config config
# Numba keeps compiled kernels in a folder that its user may write to.
ENV PATH=/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/tmp/numba
USER 10001
VOLUME /data
ENTRYPOINT ["sitegrid"]
CMD ["--help"]
