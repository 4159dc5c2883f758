"""Build of vli_calibration, for pip and for colcon (ament_python)."""

from setuptools import find_packages, setup

setup(
    name="vli_calibration",
    version="0.1.0",
    description="Calibration of camera, laser plane and IMU, with the intervals of what they are worth",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_calibration": ["py.typed", "*.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_calibration"]),
        ("share/vli_calibration", ["package.xml"]),
    ],
    install_requires=[
        "vli_common==0.1.0",
        "vli_driver==0.1.0",
        "AllanTools>=2019.9",
        "gtsam>=4.2",
        "Jinja2>=3.1",
        "matplotlib>=3.6",
        "numpy>=1.26",
        "opencv-python-headless>=4.7,<5",
        "PyYAML>=6.0",
        "scipy>=1.11",
        "tqdm>=4.64",
    ],
    zip_safe=False,
)
