#!/bin/sh
# A driver in a shell: sh gateway_driver.sh TOKEN [ROBOT [URL]]
# It publishes odometry and a sighting at 5 Hz, and prints the pose. `date` must know %N (GNU).
token=$1 robot=${2:-r1} url=${3:-http://127.0.0.1:8447}

send() { # INPUT JSON
  curl --silent --show-error --max-time 5 --header "Authorization: Bearer $token" \
    --data "$2" "$url/in/$robot/$1" || echo "no gateway at $url" >&2
}

last=$(date +%s%N)
while sleep 0.2; do
  now=$(date +%s%N)
  send odometry "{\"from_ns\": $last, \"stamp_ns\": $now, \"distance_m\": 0.02, \"turn_rad\": 0}"
  send sightings "{\"stamp_ns\": $now, \"sightings\":
    [{\"id\": \"door\", \"range_m\": 2.0, \"bearing_rad\": 0.1}]}"
  curl --silent --max-time 5 --header "Authorization: Bearer $token" "$url/pose/$robot" && echo
  last=$now
done
