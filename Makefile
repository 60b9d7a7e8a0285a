# The course's commands. Each sets up .venv when it is missing, and works twice in a row.
#
#   make course      execute every notebook and make a site of them to browse
#   make slides      lecture slides from the executed notebooks; they need no network
#   make student     the notebooks without their solutions
#   make test        the tests, then every notebook against its stored outputs
#   make lab         JupyterLab on the notebooks
#   make notebooks   execute the notebooks and store their outputs in them
#   make mujoco      add the simulator of seven more tasks, those of the paper's Table 6
#   make lock        resolve environment.lock and mujoco.lock anew from pyproject.toml
#   make resolve     ask for ready-made packages for Linux, macOS and Windows; nothing is installed
#   make release     wheel, source archive, and an archive of data/ for those who install the wheel
#   make clean       remove all that make has made, .venv too
#
# Another Python than python3: make PYTHON=python3.11 test

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin/python
READY := $(VENV)/ready
# Twice quiet: errors are shown, warnings are not.
PIP := $(BIN) -m pip install --quiet --quiet
UV := build/uv/bin/uv

NOTEBOOKS := $(sort $(wildcard notebooks/[0-9]*.ipynb))
EXECUTED := $(NOTEBOOKS:%=build/pages/%)
WHAT_NOTEBOOKS_USE := $(shell find tutorial_lib data -type f -not -name '*.pyc')

# One thread: the same numbers on every machine with the same instruction set, and on a small or busy one
# many times faster than several.
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# The course's pages are UTF-8, and its notebooks know nothing of their reader's own IPython settings.
export PYTHONUTF8 := 1
export IPYTHONDIR := $(CURDIR)/build/ipython

.PHONY: course slides student test lab notebooks mujoco lock resolve release clean
.NOTPARALLEL:
.DELETE_ON_ERROR:

# The site is built beside links to what the notebooks' own links lead to; what is a page of it is copied.
course: $(READY) $(EXECUTED)
	@rm -rf build/site $(filter-out $(EXECUTED),$(wildcard build/pages/notebooks/*))
	@rm -rf build/pages/data && mkdir build/pages/data && ln -sfn ../../tutorial_lib ../../benchmarks build/pages
	@ln -s $(patsubst %,../../../%,$(filter-out data/README.md,$(wildcard data/*))) build/pages/data
	@cp data/README.md build/pages/data && cp site/*.md build/pages
	@$(BIN) -m sphinx -q -W --keep-going -d build/doctrees -c site build/pages build/site
	@echo "The course lies at $(CURDIR)/build/site/index.html: open it in a browser."

# Beside links to what the notebooks' own links lead to, as the site.
slides: $(READY) $(EXECUTED)
	@rm -rf build/slides $(filter-out $(EXECUTED),$(wildcard build/pages/notebooks/*)) && mkdir -p build/slides
	@ln -sfn ../data ../tutorial_lib ../benchmarks build
	@$(BIN) site/slides.py build/pages/notebooks build/slides
	@echo "The slides lie at $(CURDIR)/build/slides/index.html: open it in a browser."

student: $(READY)
	@rm -rf build/student && mkdir -p build && ln -sfn ../data ../tutorial_lib ../benchmarks build
	@$(BIN) site/student.py notebooks build/student
	@echo "The notebooks without solutions lie in $(CURDIR)/build/student."

test: $(READY)
	@$(BIN) -m pytest --durations=10 tests
	@$(if $(NOTEBOOKS),$(BIN) -m pytest --durations=10 --nbval-lax --nbval-current-env --nbval-cell-timeout 600 \
		--nbval-sanitize-with tests/sanitize.cfg $(NOTEBOOKS))

lab: $(READY)
	@$(BIN) -m jupyterlab --ip=127.0.0.1 --LabApp.default_url=/lab/tree/notebooks \
		$(if $(filter 0,$(shell id -u)),--allow-root)

notebooks: $(EXECUTED)
	@cp -p $(EXECUTED) notebooks

# The kernel warns at every start that it talks in plain text, unless it need not.
QUIETLY := --log-level=ERROR --KernelManager.transport_encryption=auto

# A notebook runs in its own folder. Its sliders write the pictures with which they move on the site. What
# stays of it: outputs and counts, and no trace of the machine. A cell that takes ten minutes hangs.
build/pages/%.ipynb: %.ipynb $(WHAT_NOTEBOOKS_USE) $(READY)
	@mkdir -p $(@D) && rm -rf build/pages/pictures/$(*F)
	@printf '%-50s' $<; start=$$(date +%s); C2IQL_PICTURES="$(CURDIR)/build/pages/pictures/$(*F)" \
	$(BIN) -m nbconvert $(QUIETLY) --ExecutePreprocessor.timeout=600 --to notebook --execute --output-dir $(@D) $< && \
	$(BIN) -m nbstripout --keep-output --keep-count --keep-id --extra-keys metadata.language_info $@ && \
	echo "$$(($$(date +%s) - start)) s"

# The lock's torch goes first, alone, with what it asks for: so each machine gets the build that suits it, CPU
# or CUDA. The rest asks for nothing, as the lock is complete, and pip would refuse bullet-safety-gym's pin.
$(READY): environment.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit("The course needs Python 3.11 or \
	newer, and $(PYTHON) is %d.%d. Try: make PYTHON=python3.11 $(MAKECMDGOALS)" % v[:2])'
	@echo "Setting up $(VENV): some minutes, 2 GB (more where PyTorch brings CUDA)."
	@$(PYTHON) -m venv $(VENV)
	@echo "1 of 3: PyTorch"
	@$(PIP) --constraint environment.lock torch
	@echo "2 of 3: all other packages. Where pip compiles the simulator, this takes some ten minutes."
	@$(PIP) --no-deps --requirement environment.lock
	@echo "3 of 3: the course's own library"
	@$(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

# An extra of 110 MB. It asks for nothing, as both locks together are complete, and changes no other package.
mujoco: $(READY)
	@$(PIP) --no-deps --requirement mujoco.lock
	@$(BIN) -m tutorial_lib tasks

$(UV):
	@$(PYTHON) -m venv build/uv
	@build/uv/bin/python -m pip install --quiet --quiet uv

# Keeps the releases that are in the lock where they still fit; remove the file first to take the newest of all.
# The overrides, and why bullet-safety-gym needs one, are in pyproject.toml.
lock: $(UV)
	@$(UV) pip compile pyproject.toml --output-file environment.lock --quiet \
		--no-annotate --custom-compile-command "make lock"
	@cp environment.lock build/uv/with-mujoco.lock
	@$(UV) pip compile pyproject.toml --extra mujoco --output-file build/uv/with-mujoco.lock --quiet \
		--no-annotate --custom-compile-command "make lock"
	@{ head -n 2 environment.lock; grep -v '^#' build/uv/with-mujoco.lock | grep -vxFf environment.lock; } >mujoco.lock

# Fails where a package of the locks has no ready-made wheel for a system that README.md calls resolved. PyTorch's
# wheels need macOS 14. uv reads nothing in pyproject.toml here, and downloads no Python.
resolve: $(UV)
	@for system in x86_64-unknown-linux-gnu aarch64-apple-darwin x86_64-pc-windows-msvc; do \
		for python in 3.11 3.12 3.13; do \
			echo "$$system, Python $$python"; \
			MACOSX_DEPLOYMENT_TARGET=14.0 UV_PYTHON_DOWNLOADS=never $(UV) pip compile environment.lock mujoco.lock \
				--no-config --quiet --no-deps --only-binary :all: --python-platform $$system --python-version $$python \
				>/dev/null || exit 1; \
		done; \
	done

# Built from a copy, so that setuptools leaves nothing in the project's folder.
release: $(READY)
	@rm -rf build/release && mkdir -p build/release/source
	@cp -r tutorial_lib pyproject.toml MANIFEST.in README.md LICENSE build/release/source
	@cd build/release/source && $(CURDIR)/$(BIN) -c \
		'from setuptools.build_meta import *; build_wheel(".."), build_sdist("..")' >../log 2>&1 || { cat ../log; exit 1; }
	@rm -r build/release/source build/release/log
	@$(BIN) -c 'from tutorial_lib.data.release import write_archive; write_archive("data", "build/release")'

clean:
	@rm -rf build $(VENV) *.egg-info .pytest_cache .ruff_cache .mypy_cache
	@find . -name __pycache__ -prune -exec rm -rf {} +
