# Targets: robot (planning), cloud (planning, server), bench (relay, tables). One base, no compiler in any of them.
FROM python:3.13-slim AS base
ENV PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 PATH=/opt/offboard/bin:$PATH
# The planner is compiled for the CPU it runs on, at first start; the cache is worth a volume.
ENV NUMBA_CACHE_DIR=/var/cache/offboard
RUN python3 -m venv /opt/offboard \
 && groupadd --gid 10001 offboard \
 && useradd --uid 10001 --gid offboard --no-create-home --shell /usr/sbin/nologin offboard \
 && install -d -o offboard -g offboard /var/cache/offboard /out \
 && install -d -o offboard -g offboard -m 0700 /keys /keys-robot /token

FROM base AS wheel
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY offboard offboard
COPY common common
COPY robot_client robot_client
COPY cloud_server cloud_server
COPY loadgen loadgen
RUN pip wheel --quiet --no-deps --wheel-dir /wheels .
# One time stamp in all images: the cache of the compiled planner is shared by containers and goes by it.
RUN printf '%s\n' '#!/bin/sh' 'set -e' 'pip install --quiet --no-cache-dir --no-deps /wheels/*.whl' \
      'find /opt/offboard/lib -path "*/common/*.py" -exec touch -r /wheels/install {} +' \
      'find /opt/offboard/lib -path "*/robot_client/*.py" -exec touch -r /wheels/install {} +' > /wheels/install \
 && chmod +x /wheels/install

FROM base AS robot
COPY requirements/robot.txt /tmp/requirements.txt
RUN pip install --quiet --no-cache-dir --require-hashes -r /tmp/requirements.txt
COPY --from=wheel /wheels /wheels
RUN /wheels/install
USER offboard
ENTRYPOINT ["robot-client"]

FROM base AS cloud
COPY requirements/cloud.txt /tmp/requirements.txt
RUN pip install --quiet --no-cache-dir --require-hashes -r /tmp/requirements.txt
COPY --from=wheel /wheels /wheels
RUN /wheels/install
USER offboard
EXPOSE 5555 8000
HEALTHCHECK --interval=2s --timeout=2s --start-period=60s --retries=3 \
  CMD ["python3", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/ready', timeout=1)"]
ENTRYPOINT ["cloud-server"]

FROM base AS bench
COPY requirements/bench.txt /tmp/requirements.txt
RUN pip install --quiet --no-cache-dir --require-hashes -r /tmp/requirements.txt
COPY --from=wheel /wheels /wheels
RUN /wheels/install
USER offboard
EXPOSE 5555 8001
HEALTHCHECK --interval=2s --timeout=2s --start-period=20s --retries=3 \
  CMD ["python3", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8001/health', timeout=1)"]
ENTRYPOINT ["loadgen"]

# The unit tests on the image's Python.
FROM bench AS test
USER root
COPY requirements/dev.txt /tmp/requirements.txt
RUN pip install --quiet --no-cache-dir --require-hashes -r /tmp/requirements.txt
WORKDIR /src
COPY . .
RUN chown -R offboard /src
USER offboard
ENTRYPOINT ["python3", "-m", "pytest", "-p", "no:cacheprovider"]
# The learned predictors, the tables of docs/, A* and jump points, reports and simulations take minutes, and are tested outside.
CMD ["--numprocesses=2", "tests/unit", "--ignore=tests/unit/test_learned.py", "--ignore=tests/unit/test_datasets.py", \
  "--ignore=tests/unit/test_accelerations.py", "--ignore=tests/unit/test_report.py", "--ignore-glob=*test_simulation*"]
