"""Build of vli_bringup, for pip and for colcon (ament_python)."""

from glob import glob

from setuptools import find_packages, setup

setup(
    name="vli_bringup",
    version="0.1.0",
    description="The vli command: offline pipeline, replay, evaluation and demo of the scanner",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_bringup": ["py.typed", "data/**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_bringup"]),
        ("share/vli_bringup", ["package.xml"]),
        ("share/vli_bringup/launch", glob("launch/*.launch.py")),
        ("share/vli_bringup/config", glob("vli_bringup/data/config/*.yaml")),
        ("share/vli_bringup/rviz", glob("vli_bringup/data/config/rviz/*")),
        ("share/vli_bringup/foxglove", glob("vli_bringup/data/config/foxglove/*")),
    ],
    install_requires=[
        "vli_common==0.1.0",
        "vli_driver==0.1.0",
        "vli_frontend==0.1.0",
        "vli_backend==0.1.0",
        "vli_mapping==0.1.0",
        "vli_calibration==0.1.0",
        "vli_simulation==0.1.0",
        "matplotlib>=3.6",
        "mcap>=1.6",
        "numpy>=1.26",
        "opencv-python-headless>=4.6,<5",
        "PyYAML>=6.0",
        "rosbags>=0.11",
        "scipy>=1.11",
        "tqdm>=4.64",
    ],
    extras_require={"view": ["viser>=1.0"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "vli = vli_bringup.cli:main",
        ],
    },
)
