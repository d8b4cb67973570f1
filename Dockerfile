# One image for both services: `foottile serve` and `foottile node`; with other extras, for a cluster
# (deploy/docker-compose.yml).
#
#   docker build -t foottile .
#
# Works on amd64 and arm64 (Raspberry Pi OS, 64 bit).

FROM python:3.12-slim-bookworm AS build
WORKDIR /src
ARG LOCK=requirements.lock
COPY $LOCK ./
# Every download is compared with its hash here; what follows takes nothing from anywhere else.
RUN pip download --no-cache-dir --no-deps --require-hashes -r $LOCK -d /wheels
# .dockerignore names what there is to copy.
COPY . .
ARG EXTRAS=server,emulation
RUN pip install --no-index --find-links /wheels hatchling \
    && pip wheel --no-deps --no-build-isolation -w /dist . \
    && python -m venv /opt/foottile \
    && /opt/foottile/bin/pip install --no-index --find-links /wheels \
        "$(ls /dist/foottile-*.whl)[$EXTRAS]"

FROM python:3.12-slim-bookworm
COPY --from=build /opt/foottile /opt/foottile
COPY scripts/container-node /usr/local/bin/foottile-node
RUN useradd --create-home --uid 1000 foottile && install -d -o foottile -g foottile /data /home/foottile/.cache \
    /home/foottile/.local /home/foottile/.local/state
ENV PATH=/opt/foottile/bin:$PATH PYTHONUNBUFFERED=1
USER foottile
VOLUME /data
EXPOSE 8000
STOPSIGNAL SIGTERM
# Without FOOTTILE_TOKEN it makes a token, which is not in the log. A link that logs a browser in, once:
# docker exec NAME foottile invite
CMD ["foottile", "serve", "--host", "0.0.0.0", "--data", "/data"]
