#!/bin/sh
# Runs a command in a network of its own with multicast on loopback, where such a network can be created.
up='ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo'
for how in --net '--map-root-user --net'; do
  if unshare $how sh -c "$up" 2>/dev/null; then
    export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET
    exec unshare $how sh -c "$up"' && exec "$@"' alone "$@"
  fi
done
echo "no network namespace can be created: DDS uses this computer alone, without multicast" >&2
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
exec "$@"
