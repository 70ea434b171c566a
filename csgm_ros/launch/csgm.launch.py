"""Start the node, with RViz if wanted: ros2 launch csgm_ros csgm.launch.py source_topic:=/map target_topic:=/points."""

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


def flag(name: str) -> ParameterValue:
    """Return a launch argument as a boolean parameter."""
    return ParameterValue(LaunchConfiguration(name), value_type=bool)


def arguments() -> list[DeclareLaunchArgument]:
    """Return what can be set from the command line."""
    switch = ['true', 'false']
    profile = EnvironmentVariable(DDS_PROFILE, default_value=shared('config', 'fastdds.xml'))
    return [
        DeclareLaunchArgument('source_topic', default_value='source', description='cloud that is moved, such as SfM'),
        DeclareLaunchArgument('target_topic', default_value='target', description='cloud that stays, such as a Kinect'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the node'),
        DeclareLaunchArgument('config', default_value=shared('config', 'csgm.yaml'), description='parameter file'),
        DeclareLaunchArgument(
            'trigger',
            default_value='on_request',
            description='when to register',
            choices=['on_request', 'on_first_pair', 'on_new_source', 'on_every_pair'],
        ),
        DeclareLaunchArgument(
            'autostart', default_value='true', description='no lifecycle manager needed', choices=switch
        ),
        DeclareLaunchArgument('publish_tf', default_value='false', description='rigid part to TF', choices=switch),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='time from /clock', choices=switch),
        DeclareLaunchArgument('frame', default_value='camera', description='frame of the target, for RViz'),
        DeclareLaunchArgument('rviz', default_value='false', description='start RViz', choices=switch),
        DeclareLaunchArgument('dds_profile', default_value=profile, description='Fast DDS profile of every process'),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, the node and RViz."""
    node = LifecycleNode(
        package='csgm_ros',
        executable='csgm_node',
        name='csgm',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('config'),
            {
                'trigger': LaunchConfiguration('trigger'),
                'autostart': flag('autostart'),
                'publish_tf': flag('publish_tf'),
                'use_sim_time': flag('use_sim_time'),
            },
        ],
        remappings=[('source', LaunchConfiguration('source_topic')), ('target', LaunchConfiguration('target_topic'))],
        output='screen',
    )
    topics = [(f'/csgm/{name}', f'csgm/{name}') for name in ('fused', 'aligned', 'graphs')]
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        arguments=['-d', shared('config', 'csgm.rviz'), '-f', LaunchConfiguration('frame')],
        parameters=[{'use_sim_time': flag('use_sim_time')}],
        remappings=[
            ('/source', LaunchConfiguration('source_topic')),
            ('/target', LaunchConfiguration('target_topic')),
            *topics,  # absolute in the file, and so in the node's namespace
        ],
        condition=IfCondition(LaunchConfiguration('rviz')),
    )
    environment = SetEnvironmentVariable(DDS_PROFILE, LaunchConfiguration('dds_profile'))
    return LaunchDescription([*arguments(), environment, node, rviz])
