"""Build the package with colcon."""

from setuptools import setup

setup(
    name="cloudrc_nodes",
    version="0.1.0",
    packages=["cloudrc_nodes"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/cloudrc_nodes"]),
        ("share/cloudrc_nodes", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    entry_points={"console_scripts": ["controller = cloudrc_nodes.controller:main"]},
)
