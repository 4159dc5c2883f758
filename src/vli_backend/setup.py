"""Build of vli_backend, for pip and for colcon (ament_python)."""

from setuptools import find_packages, setup

setup(
    name="vli_backend",
    version="0.1.0",
    description="Initialisation and fixed-lag smoother of the scanner",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_backend": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_backend"]),
        ("share/vli_backend", ["package.xml"]),
    ],
    install_requires=[
        "vli_common==0.1.0",
        "gtsam>=4.3",
        "numba>=0.59",
        "numpy>=1.26",
        "opencv-python-headless>=4.6,<5",
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            # The first name is pip's, safe on a shared PATH; the second is the one of `ros2 run`.
            "vli_backend_node = vli_backend.nodes.backend_node:main",
            "backend_node = vli_backend.nodes.backend_node:main",
        ],
    },
)
