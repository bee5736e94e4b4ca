# Everything runs in .venv, which each target makes for itself. Needs Python 3.11 or 3.12 and make.
#   make demo [ARGS="..."]   make test   make bench   make pictures   make venv   make clean

SHELL := /bin/sh
VENV := .venv
READY := $(VENV)/.ready
BIN := $(VENV)/bin

# The wheels of rclpy in .venv must not meet the libraries of a sourced /opt/ros, nor those of the
# environment that started make.
ifneq ($(AMENT_PREFIX_PATH)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport LD_LIBRARY_PATH
endif
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
unexport RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE VIRTUAL_ENV

.PHONY: venv demo test bench pictures clean

venv: $(READY)

# The stamp holds the folder it was made in: a venv does not survive being moved.
ifneq ($(shell cat $(READY) 2>/dev/null),$(CURDIR))
$(READY): again
endif
.PHONY: again

# A venv that is broken or was moved is made anew; a sound one is only brought up to date.
$(READY): setup.py constraints.txt Makefile
	@if ! [ "$$($(BIN)/python -c 'import pip, sys; print(sys.prefix)' 2>/dev/null)" = "$(CURDIR)/$(VENV)" ] \
	    || ! head -1 $(BIN)/pip 2>/dev/null | grep -qF "$(CURDIR)/$(VENV)/"; then \
	  python=; \
	  for candidate in $(PYTHON) python3.12 python3.11 python3; do \
	    if $$candidate -c 'import ensurepip, sys, venv; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' \
	        2>/dev/null; then python=$$candidate; break; fi; \
	  done; \
	  if [ -z "$$python" ]; then \
	    echo "sph_ros needs Python 3.11 or 3.12 with its venv module, and found none. On Debian or" >&2; \
	    echo "Ubuntu: sudo apt install python3-venv. One elsewhere: make venv PYTHON=/path/to/python3" >&2; \
	    exit 1; \
	  fi; \
	  echo "making $(VENV) with $$($$python --version)"; \
	  rm -rf $(VENV); $$python -m venv $(VENV) || exit 1; \
	fi
	@echo "installing into $(VENV): one to three minutes, about 1.2 GB"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  --constraint constraints.txt --editable '.[ros,test]'
	@echo "$(CURDIR)" > $@

demo: $(READY)
	@exec $(BIN)/sph_ros demo $(ARGS)

# First what fails quickly, last the whole suite. Without JIT the kernels run as plain Python: their
# indices are checked and coverage tools see into them.
test: $(READY)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q -m nojit
	$(BIN)/python -m pytest -q $(ARGS)

bench: $(READY)
	$(BIN)/python benchmarks/run.py $(ARGS)

# The pictures of the README: last frames of offline runs, and the webcam's film; takes half an hour.
# A scene and the moment of its picture [s]:
MOMENTS := desk_tank:0.5 dam_break:0.5 dam_break_2d:0.35 dam_break_large:0.5 resting_column:0.5 pour_glass:1.2 dam_house_2d:1.8 \
  drops_merge:0.3 stirred_cup:1.6 floating_boat:1.5 ball_splash:0.3 oil_water:1.2 fountain:1.2 \
  honey_spoon:2 cream:3 jelly:0.1 lennard_jones:1
FFMPEG = "$$($(BIN)/python -c 'import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())')" -y -loglevel error
pictures: $(READY)
	mkdir -p docs/scenes
	$(BIN)/sph_ros simulate ball_tank_large --bag hand_stir --seconds 17.1 --fps 10 --out out/ball_tank_large --force
	$(BIN)/sph_ros simulate ball_tank --bag hand_stir --seconds 10 --fps 1 --out out/ball_tank --force
	$(BIN)/sph_ros simulate drop_box --bag hand_push --seconds 0.95 --fps 20 --out out/drop_box --force
	for shot in $(MOMENTS); do scene=$${shot%:*}; \
	  $(BIN)/sph_ros simulate $$scene --seconds $${shot#*:} --fps 20 --out out/$$scene --force || exit 1; done
	$(BIN)/sph_ros simulate rain_2d --fps 1 --out out/rain_2d --force
	cp out/ball_tank_large/last.png docs/ball_tank.png
	for scene in ball_tank ball_tank_large drop_box rain_2d $(foreach shot,$(MOMENTS),$(firstword $(subst :, ,$(shot)))); do \
	  $(FFMPEG) -i out/$$scene/last.png -vf scale=400:-1:flags=lanczos -c:v libwebp -quality 80 \
	    docs/scenes/$$scene.webp || exit 1; done
	$(BIN)/sph_ros webcam --make-video out/desk.mp4
	$(BIN)/sph_ros webcam --source out/desk.mp4 --headless --rate 0.25 --out out/webcam --force
	$(FFMPEG) -ss 1 -t 9 -i out/webcam/webcam.mp4 -vf fps=12,scale=480:-1:flags=lanczos \
	  -c:v libwebp_anim -quality 55 -compression_level 6 -loop 0 docs/webcam.webp

clean:
	rm -rf $(VENV) build install log out *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
