"""Build of vli_common, for pip and for colcon (ament_python)."""

from setuptools import find_packages, setup

setup(
    name="vli_common",
    version="0.1.0",
    description="Types, geometry, calibration and ROS plumbing shared by the packages of the scanner",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_common": ["py.typed", "**/*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_common"]),
        ("share/vli_common", ["package.xml"]),
    ],
    install_requires=[
        "gtsam>=4.3",
        "numba>=0.59",
        "numpy>=1.26",
        "plyfile>=1.0",
        "PyYAML>=6.0",
    ],
    zip_safe=False,
)
