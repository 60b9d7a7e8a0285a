# The course on a machine of its own: Debian, Python 3.11 and what .ci/run installs.
#
#   docker build --tag c2iql .
#   docker run --rm --publish 127.0.0.1:8888:8888 c2iql    # prints the address of JupyterLab
#   docker run --rm c2iql .ci/run                          # tests everything
#
# The image has a C++ compiler: on machines with an Arm processor pip compiles the simulator.
FROM python:3.11-bookworm

RUN apt-get update -q \
    && apt-get install -q -y --no-install-recommends chromium make \
    && rm -rf /var/lib/apt/lists/*

# A user of one's own, with the name and number that Binder asks for.
ARG NB_USER=student
ARG NB_UID=1000
RUN useradd --create-home --uid ${NB_UID} ${NB_USER}
ENV HOME=/home/${NB_USER}
WORKDIR ${HOME}/course
RUN chown ${NB_UID} .
USER ${NB_UID}
COPY --chown=${NB_UID} . .

# PyTorch's own index has builds for the CPU alone, which are much smaller.
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1
RUN make .venv/ready

# Binder starts `jupyter notebook`, which is not in the lock.
RUN .venv/bin/python -m pip install --quiet --constraint environment.lock notebook
ENV PATH=${HOME}/course/.venv/bin:${PATH}
ENV OMP_NUM_THREADS=1

EXPOSE 8888
CMD ["jupyter", "lab", "--ip=0.0.0.0", "--no-browser", "--LabApp.default_url=/lab/tree/notebooks"]
