# Targets: robot (planning), cloud (planning, server), bench (relay, tables), examples (robot and cloud of an application),
# prometheus. They share one base; none contains a compiler.
FROM python:3.13-slim AS base
ENV PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 PATH=/opt/offboard/bin:$PATH
# The planner is compiled at the first start, for the CPU that it runs on. Keep the cache in a volume.
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
COPY maps maps
RUN pip wheel --quiet --no-deps --wheel-dir /wheels .
# All images get the same file times: containers share the cache of the compiled planner, and numba compares file times.
RUN printf '%s\n' '#!/bin/sh' 'set -e' 'pip install --quiet --no-cache-dir --no-deps /wheels/*.whl' \
      'find /opt/offboard/lib -path "*/common/*.py" -exec touch -r /wheels/install {} +' \
      'find /opt/offboard/lib -path "*/loadgen/robot/*.py" -exec touch -r /wheels/install {} +' > /wheels/install \
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

# Robot and cloud of a scenario whose task is in examples/; it has no entrypoint, because it is either.
FROM base AS examples
# pinocchio, of examples/arm.py, needs it.
RUN apt-get update -qq && apt-get install -qq --no-install-recommends libgomp1 > /dev/null && rm -rf /var/lib/apt/lists/*
COPY requirements/examples.txt /tmp/all.txt
# pyroboplan asks for toppra, which has no wheel. The planner of examples/arm.py does not import it.
RUN sed '/^toppra==/,/[^\\]$/d' /tmp/all.txt > /tmp/requirements.txt \
 && pip install --quiet --no-cache-dir --no-deps --only-binary :all: --require-hashes -r /tmp/requirements.txt
COPY --from=wheel /wheels /wheels
RUN /wheels/install
COPY --chmod=755 examples /opt/applications/examples
ENV PYTHONPATH=/opt/applications
USER offboard

FROM base AS prometheus
RUN apt-get update -qq && apt-get install -qq --no-install-recommends prometheus > /dev/null && rm -rf /var/lib/apt/lists/* \
 && install -d -o offboard -g offboard /prometheus
COPY deploy/prometheus /etc/prometheus
USER offboard
EXPOSE 9090
ENTRYPOINT ["prometheus", "--config.file=/etc/prometheus/prometheus.yml", "--storage.tsdb.path=/prometheus"]

# Runs the unit tests of what robots and servers run, with the Python of the image.
FROM bench AS test
USER root
COPY requirements/dev.txt /tmp/requirements.txt
RUN pip install --quiet --no-cache-dir --require-hashes -r /tmp/requirements.txt
WORKDIR /src
COPY . .
RUN chown -R offboard /src
USER offboard
# Other tests run outside: those of the test bench, and those that take minutes.
RUN grep -LE 'offboard\.loadgen|benchmarks' tests/unit/test_*.py | grep -vE 'test_(learned|accelerations)' > tests.txt
ENTRYPOINT ["python3", "-m", "pytest", "-p", "no:cacheprovider"]
CMD ["--numprocesses=2", "-m", "not long", "@/src/tests.txt"]
