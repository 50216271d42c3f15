# docker build -t cleargs . && docker run --rm -v "$PWD:/work" cleargs run walk.mp4
FROM python:3.12-slim
ARG TORCH_INDEX=
COPY . /tmp/cleargs
RUN pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" -c /tmp/cleargs/constraints.txt '/tmp/cleargs[heif]' \
    && rm -rf /tmp/cleargs
WORKDIR /work
ENTRYPOINT ["cleargs"]
