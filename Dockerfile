# dexsim in a container:
#   docker build -t dexsim .     (--build-arg TORCH=cpu: without a GPU)
#   docker run --gpus all --shm-size=1g -v "$PWD/runs:/work/runs" dexsim train task=grasp
# Every step is also run without Docker, in a fresh Debian (tools/debian.py, .ci/nightly).
FROM debian:bookworm-slim
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv git ca-certificates libegl1 libosmesa6 libgl1 && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY pyproject.toml setup.py README.md LICENSE ./
COPY locks locks
COPY checkpoints checkpoints
COPY dexsim dexsim
# TORCH=cpu: without a GPU, and gigabytes smaller
ARG TORCH=torch
RUN python3 -m venv /opt/dexsim && /opt/dexsim/bin/pip install --no-cache-dir --no-deps --require-hashes -r locks/base.txt
RUN if [ "$TORCH" = cpu ]; then /opt/dexsim/bin/pip install --no-cache-dir --no-deps torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu; else /opt/dexsim/bin/pip install --no-cache-dir --no-deps --require-hashes -r locks/torch.txt; fi
RUN /opt/dexsim/bin/pip install --no-cache-dir --no-deps --no-build-isolation .
RUN /opt/dexsim/bin/dexsim --version
ENV PATH=/opt/dexsim/bin:$PATH
WORKDIR /work
ENTRYPOINT ["dexsim"]
CMD ["doctor"]
