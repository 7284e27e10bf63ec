# qs3 in a container, with PyTorch's CPU build:
#
#   docker build -t qs3 .
#   docker run --rm -v "$PWD:/work" qs3 predict rooms my_scan.ply
#
# For a GPU, take another index: --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu126,
# and run with --gpus all. More extras: --build-arg EXTRAS=cad,view.
FROM python:3.12-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG EXTRAS=cad

# libLLVM for Mitsuba's fast variant; libgomp for OpenMP.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libgomp1 libllvm19 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/qs3
COPY pyproject.toml constraints.txt README.md LICENSE ./
RUN pip install --no-cache-dir -c constraints.txt --index-url "$TORCH_INDEX" torch
COPY src src
RUN pip install --no-cache-dir -c constraints.txt ".[$EXTRAS]"

RUN useradd --create-home qs3
USER qs3
WORKDIR /work
ENTRYPOINT ["qs3"]
CMD ["--help"]
