# The Python of scripts/poses.py: pycolmap and what reads photographs and videos.
out/poses-env/bin/python: pipelines/poses.txt
	python3 -m venv --clear out/poses-env
	out/poses-env/bin/pip install -q -r $< || { rm -rf out/poses-env; exit 1; }
	@touch $@
