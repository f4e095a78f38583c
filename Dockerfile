# CPU image: docker build -t neuroslam .
#            docker run --rm -v "$PWD/out:/out" neuroslam                     # the demo
#            docker run --rm -v "$PWD:/out" neuroslam run drive.mp4 -o mapped # your video
# PIP_ARGS goes to pip: without the choice of a CPU build of torch Linux gets the CUDA libraries too.
FROM python:3.11-slim

ARG PIP_ARGS=""
ENV PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/cache/numba \
    MPLCONFIGDIR=/cache/matplotlib

WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY configs configs
COPY neuroslam neuroslam
RUN pip install --no-cache-dir --constraint constraints.txt ${PIP_ARGS} . \
    && useradd --create-home robot \
    && mkdir -p /out /cache \
    && chown robot /out /cache

USER robot
WORKDIR /out
VOLUME /out
ENTRYPOINT ["neuroslam"]
CMD ["demo", "--out", "demo"]
