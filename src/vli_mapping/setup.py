"""Build of vli_mapping, for pip and for colcon (ament_python)."""

from setuptools import find_packages, setup

setup(
    name="vli_mapping",
    version="0.1.0",
    description="Coloured point map and window-to-map association of the scanner",
    maintainer="The vli-slam maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(),
    package_data={"vli_mapping": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vli_mapping"]),
        ("share/vli_mapping", ["package.xml"]),
    ],
    install_requires=[
        "vli_common==0.1.0",
        "numba>=0.59",
        "numpy>=1.26",
        "opencv-python-headless>=4.6,<5",
        "scipy>=1.11",
    ],
    extras_require={
        "export": ["laspy[lazrs]>=2.5", "pye57>=0.4"],
        "mesh": ["scikit-image>=0.22", "trimesh>=4.0"],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            # The first name is pip's, safe on a shared PATH; the second is the one of `ros2 run`.
            "vli_mapping_node = vli_mapping.nodes.mapping_node:main",
            "mapping_node = vli_mapping.nodes.mapping_node:main",
        ],
    },
)
