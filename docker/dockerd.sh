#!/usr/bin/env bash
# Docker on a Debian or Ubuntu machine without systemd, as root:
#   docker/dockerd.sh start [FOLDER]   installs what is missing; uses the daemon that answers, else starts one
#   docker/dockerd.sh stop [FOLDER]    stops the daemon that `start` started, and no other
# FOLDER keeps its log and its process id; default: /var/tmp/cpcbl-dockerd.
set -euo pipefail

usage() {
  echo "usage: docker/dockerd.sh start|stop [FOLDER]" >&2
  exit 2
}

answers() { timeout 5 docker info >/dev/null 2>&1; }

# The process id of our own daemon, if it runs: a recycled id is some other program.
own_daemon() {
  local pid
  pid=$(cat "$pid_file" 2>/dev/null) && [ "$(cat "/proc/$pid/comm" 2>/dev/null)" = dockerd ] && echo "$pid"
}

install_missing() {
  local missing=()
  command -v dockerd >/dev/null || missing+=(docker.io)
  docker compose version >/dev/null 2>&1 || command -v docker-compose >/dev/null || missing+=(docker-compose)
  [ ${#missing[@]} -eq 0 ] && return
  echo "installing ${missing[*]}"
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >"$folder/apt.log" 2>&1 ||
    { tail -5 "$folder/apt.log" >&2; exit 1; }
}

start() {
  mkdir -p "$folder"
  install_missing
  if answers; then
    echo "a Docker daemon answers already"
    return
  fi
  mountpoint -q /sys/fs/cgroup || { echo "no cgroups here: apt-get install cgroupfs-mount, then cgroupfs-mount" >&2; exit 1; }
  own_daemon >/dev/null || rm -f "$pid_file" # dockerd does not start over a stale one
  setsid dockerd --pidfile "$pid_file" >"$folder/dockerd.log" 2>&1 </dev/null &
  local daemon=$!
  for _ in $(seq 120); do
    answers && { echo "started a Docker daemon, process $(own_daemon)"; return; }
    kill -0 "$daemon" 2>/dev/null || break
    sleep 0.5
  done
  echo "dockerd did not start; the end of $folder/dockerd.log:" >&2
  tail -10 "$folder/dockerd.log" >&2
  exit 1
}

stop() {
  local pid
  pid=$(own_daemon) || { echo "no daemon of ours runs"; return; }
  kill -TERM "$pid" # it stops its containers first
  for _ in $(seq 60); do
    [ -d "/proc/$pid" ] || { echo "stopped"; return; }
    sleep 0.5
  done
  kill -KILL "$pid"
  echo "killed: it did not stop within 30 s"
}

PATH=$PATH:/usr/sbin:/sbin
folder=${2:-/var/tmp/cpcbl-dockerd}
pid_file=$folder/dockerd.pid
case ${1:-} in
  start) start ;;
  stop) stop ;;
  *) usage ;;
esac
