"""Follow a depth sensor in a map: ros2 launch csgm_ros localization.launch.py map_file:=map.npz points_topic:=/points.

Takes every argument of csgm.launch.py that is not about pairs as well.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

DDS_PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'


def shared(*path: str) -> PathJoinSubstitution:
    """Return a file of the installed package."""
    return PathJoinSubstitution([FindPackageShare('csgm_ros'), *path])


def typed(name: str, kind: type) -> ParameterValue:
    """Return a launch argument as a parameter of a type."""
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def arguments() -> list[DeclareLaunchArgument]:
    """Return what can be set from the command line."""
    switch = ['true', 'false']
    profile = EnvironmentVariable(DDS_PROFILE, default_value=shared('config', 'fastdds.xml'))
    return [
        DeclareLaunchArgument('map_file', default_value='', description='cloud or prepared map; empty: map_topic'),
        DeclareLaunchArgument('map_topic', default_value='map', description='latched cloud, where no map_file is'),
        DeclareLaunchArgument('points_topic', default_value='points', description='clouds of the depth sensor'),
        DeclareLaunchArgument('map_frame', default_value='map', description='frame of a map from a file'),
        DeclareLaunchArgument('odom_frame', default_value='', description='of an odometry on TF, where there is one'),
        DeclareLaunchArgument('base_frame', default_value='', description="of the robot; empty: the sensor's own"),
        DeclareLaunchArgument('tf_broadcast', default_value='true', description='pose to TF', choices=switch),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the node'),
        DeclareLaunchArgument('config', default_value=shared('config', 'csgm.yaml'), description='parameter file'),
        DeclareLaunchArgument(
            'autostart', default_value='true', description='no lifecycle manager needed', choices=switch
        ),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='time from /clock', choices=switch),
        DeclareLaunchArgument('rviz', default_value='false', description='start RViz', choices=switch),
        DeclareLaunchArgument('dds_profile', default_value=profile, description='Fast DDS profile of every process'),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, the node and RViz."""
    names = ('map_file', 'map_frame', 'odom_frame', 'base_frame')
    node = LifecycleNode(
        package='csgm_ros',
        executable='csgm_node',
        name='csgm',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('config'),
            {
                'mode': 'tracking',
                **{name: typed(name, str) for name in names},
                **{name: typed(name, bool) for name in ('tf_broadcast', 'autostart', 'use_sim_time')},
            },
        ],
        remappings=[('map', LaunchConfiguration('map_topic')), ('points', LaunchConfiguration('points_topic'))],
        output='screen',
    )
    topics = [(f'/csgm/{name}', f'csgm/{name}') for name in ('map', 'pose', 'path')]
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        arguments=['-d', shared('config', 'localization.rviz'), '-f', [LaunchConfiguration('map_frame'), '_metric']],
        parameters=[{'use_sim_time': typed('use_sim_time', bool)}],
        remappings=[
            ('/points', LaunchConfiguration('points_topic')),
            ('/initialpose', 'initialpose'),
            *topics,  # absolute in the file, and so in the node's namespace
        ],
        condition=IfCondition(LaunchConfiguration('rviz')),
    )
    environment = SetEnvironmentVariable(DDS_PROFILE, LaunchConfiguration('dds_profile'))
    return LaunchDescription([*arguments(), environment, node, rviz])
