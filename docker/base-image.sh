#!/usr/bin/env bash
# A base image for machines that reach no registry of images, out of Debian or Ubuntu packages that
# apt may download (3.11 is the oldest Python that will do: Debian 12, Ubuntu 24.04, or later):
#   docker/base-image.sh [TAG]        default: cpcbl-base
#   CPCBL_BASE_IMAGE=cpcbl-base docker-compose -f docker/compose.yaml up
# apt resolves against an empty list of installed packages, the packages are unpacked, and no script
# of theirs runs. The machine's certificates go in too, so that pip works behind its proxy.
set -euo pipefail

tag=${1:-cpcbl-base}
wanted=(base-files bash ca-certificates coreutils dash findutils grep libc-bin libstdc++6 python3 python3-venv sed)
unwanted='^(perl|libperl|debconf|dpkg|openssl|install-info|mawk|libgdbm)' # for scripts that do not run here
bundle=/etc/ssl/certs/ca-certificates.crt

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
root=$scratch/root debs=$scratch/debs
mkdir -p "$debs/partial" "$root"/{etc/ssl/certs,dev,home,proc,root,run,sys,tmp,var/tmp} "$root"/usr/{bin,lib,lib64,sbin}
chmod 755 "$scratch" "$root"
chmod 1777 "$root/tmp" "$root/var/tmp"
for folder in bin lib lib64 sbin; do ln -s "usr/$folder" "$root/$folder"; done

apt-get -qq -y --no-install-recommends --download-only \
  -o Dir::State::status=/dev/null -o Dir::Cache::archives="$debs" -o Debug::NoLocking=1 -o APT::Sandbox::User=root \
  install "${wanted[@]}"
for deb in "$debs"/*.deb; do
  [[ ${deb##*/} =~ $unwanted ]] && continue
  dpkg-deb --fsys-tarfile "$deb" | tar -x -C "$root" --keep-directory-symlink \
    --exclude='./usr/share/doc/*' --exclude='./usr/share/man/*' --exclude='./usr/share/locale/*'
done

ln -sf dash "$root/usr/bin/sh"
printf '%s\n' 'root:x:0:0:root:/root:/bin/sh' 'nobody:x:65534:65534:nobody:/nonexistent:/usr/sbin/nologin' >"$root/etc/passwd"
printf '%s\n' 'root:x:0:' 'nogroup:x:65534:' >"$root/etc/group"
echo 'hosts: files dns' >"$root/etc/nsswitch.conf"
cat "$bundle" >"$root$bundle" 2>/dev/null || cat "$root"/usr/share/ca-certificates/mozilla/*.crt >"$root$bundle"
ldconfig -r "$root"

tar -C "$root" -c . | docker import -c "ENV PIP_CERT=$bundle" -c 'CMD ["bash"]' - "$tag" >/dev/null
echo "$tag: $(docker image inspect --format '{{.Size}}' "$tag" | awk '{ printf "%.0f MB", $1 / 1e6 }')"
