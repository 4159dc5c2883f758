"""Build of vli_simulation, for pip and for colcon (ament_python)."""

from setuptools import find_packages, setup

setup(
    name="vli_simulation",
    version="0.1.0",
    description="Ray-cast simulator that writes bags of the scanner with truth",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_simulation": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_simulation"]),
        ("share/vli_simulation", ["package.xml"]),
    ],
    install_requires=[
        "vli_calibration==0.1.0",
        "vli_common==0.1.0",
        "embreex>=2.17.7",
        "numba>=0.59",
        "numpy>=1.26",
        "opencv-python-headless>=4.6,<5",
        "PyYAML>=6.0",
        "rosbags>=0.10",
        "scipy>=1.11",
        "simplejpeg>=1.7",
        "tqdm>=4.64",
    ],
    zip_safe=False,
)
