# README's two commands in a container, with what they leave in ./outputs:
#   docker build --tag atlantis .
#   docker run --rm --volume "$PWD/outputs:/work/outputs" atlantis           # make run
#   docker run --rm atlantis make test
FROM python:3.12-slim
RUN apt-get update && apt-get install --yes --no-install-recommends git make && rm -rf /var/lib/apt/lists/*
WORKDIR /work
COPY . .
RUN make setup
CMD ["make", "run"]
