"""What pyproject.toml cannot say: beside the packages that are found, `data/` at the top is installed as `thermofuse.data`."""

from setuptools import find_packages, setup

found = find_packages(include=["thermofuse*", "thermography*", "interferometry*", "fusion*"])
setup(packages=[*found, "thermofuse.data"], package_dir={"thermofuse.data": "data"})
