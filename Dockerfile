# docker build -t cleargs . && docker run --rm -v "$PWD:/work" cleargs run walk.mp4
# For NVIDIA GPUs: --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128, and docker run --gpus all
FROM python:3.12-slim
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY . /tmp/cleargs
RUN pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" -c /tmp/cleargs/constraints.txt '/tmp/cleargs[heif]' \
    && rm -rf /tmp/cleargs
WORKDIR /work
ENTRYPOINT ["cleargs"]
