# The programs alone, without sources or a compiler. Build: docker build -t cags . ; run: docker run --rm -v "$PWD:/data" cags gs-geom --help
FROM rust:1.95-slim-trixie AS build
WORKDIR /src
COPY . .
RUN cargo build --release --locked --workspace --bins

FROM debian:trixie-slim
COPY --from=build /src/target/release/gs-geom /src/target/release/graph-precompute /src/target/release/feat-train \
    /src/target/release/cluster-match /src/target/release/eval /src/target/release/mask-embed \
    /src/target/release/synth-scene /usr/local/bin/
WORKDIR /data
USER 1000:1000
CMD ["eval", "--help"]
