# docker build -t cleargs . && docker run --rm --user "$(id -u):$(id -g)" -e HOME=/work -v "$PWD:/work" cleargs run walk.mp4
# The commands are those of docs/install.md, "Your own environment".
FROM python:3.12-slim
ARG PIP_EXTRA_INDEX_URL=
ENV PIP_NO_CACHE_DIR=1
COPY . /tmp/cleargs
WORKDIR /tmp/cleargs
RUN pip install -c constraints.txt '.[heif]'
WORKDIR /work
RUN cleargs doctor
ENTRYPOINT ["cleargs"]
