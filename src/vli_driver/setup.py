"""Build of vli_driver, for pip and for colcon (ament_python)."""

from setuptools import find_packages, setup

setup(
    name="vli_driver",
    version="0.1.0",
    description="Sources, demultiplexer, stripe detector and triangulator of the scanner",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_driver": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_driver"]),
        ("share/vli_driver", ["package.xml"]),
    ],
    install_requires=[
        "vli_common==0.1.0",
        "lz4>=4.0",
        "numba>=0.59",
        "numpy>=1.26",
        "opencv-python-headless>=4.6,<5",
        "PyYAML>=6.0",
        "rosbags>=0.10",
        "simplejpeg>=1.7",
        "zstandard>=0.20",
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            # The first name is pip's, safe on a shared PATH; the second is the one of `ros2 run`.
            "vli_driver_node = vli_driver.nodes.driver_node:main",
            "driver_node = vli_driver.nodes.driver_node:main",
            "vli_demux_node = vli_driver.nodes.demux_node:main",
            "demux_node = vli_driver.nodes.demux_node:main",
        ],
    },
)
