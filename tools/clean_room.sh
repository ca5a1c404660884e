#!/usr/bin/env bash
# Run a command in a bare Debian 12 that holds nothing but python3, python3-venv, git, make and curl, on a copy of this
# working tree. Shows what a newcomer meets. Needs root and debootstrap; leaves no mounts behind.
#
#   tools/clean_room.sh [--fresh] [--user] [--offline] COMMAND...
#
#   --fresh    begin with a new system and a new copy of the tree; else both are as the last command left them,
#              except that the tree is copied again
#   --user     run as a user who may not install system packages
#   --offline  run without network
#
# CLEAN_ROOM is the folder for the systems (default: clean-room in the temporary folder).
set -euo pipefail

suite=bookworm
packages=python3,python3-venv,git,make,curl,ca-certificates
room=${CLEAN_ROOM:-${TMPDIR:-/tmp}/clean-room}
tree=$(cd "$(dirname "$0")/.." && pwd)

fresh= user= offline=
while [ $# -gt 0 ]; do
    case $1 in
        --fresh) fresh=1 ;;
        --user) user=1 ;;
        --offline) offline=1 ;;
        -*) echo "unknown option $1" >&2; exit 2 ;;
        *) break ;;
    esac
    shift
done
[ $# -gt 0 ] || { sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0"; exit 2; }
[ "$(id -u)" -eq 0 ] || { echo "clean_room.sh needs root, for chroot." >&2; exit 2; }
command -v debootstrap >/dev/null || { echo "Run:  apt-get install -y debootstrap" >&2; exit 2; }

# The mirrors and the way to the network are those of this machine.
sources() { apt-get indextargets --format '$(ORIGIN) deb $(REPO_URI) $(RELEASE) main' | sed -n 's/^Debian //p' | sort -u; }

make_base() {
    local mirror
    mirror=$(sources | awk -v suite="$suite" '$3 == suite {print $2; exit}')
    [ -n "$mirror" ] || { echo "No Debian $suite mirror in this machine's apt sources." >&2; exit 1; }
    mkdir -p "$room"
    rm -rf "$room/base.part"
    debootstrap --variant=minbase --include="$packages" "$suite" "$room/base.part" "$mirror" >"$room/debootstrap.log"
    sources >"$room/base.part/etc/apt/sources.list"
    apt-config dump Acquire | grep -vE '::[A-Za-z-]+ "";$' >"$room/base.part/etc/apt/apt.conf.d/90host" || true
    mv "$room/base.part" "$room/base"
}

# What is committed and what is not yet, but nothing that git ignores: as in a fresh clone. Set-up's results stay.
copy_tree() {
    local copy=$room/system/srv/studio
    mkdir -p "$copy"
    find "$copy" -mindepth 1 -maxdepth 1 ! -name .venv ! -name '.*_cache' -exec rm -rf {} +
    git -C "$tree" ls-files -z --cached --others --exclude-standard |
        tar -C "$tree" --null --files-from=- --ignore-failed-read --warning=no-failed-read -cf - | tar -C "$copy" -xf -
}

[ -d "$room/base" ] || make_base
if [ -n "$fresh" ] || [ ! -d "$room/system" ]; then
    rm -rf "$room/system"
    cp -a "$room/base" "$room/system"
    chroot "$room/system" useradd --create-home --uid 1000 forester
fi
cp /etc/resolv.conf "$room/system/etc/resolv.conf"
cp /etc/ssl/certs/ca-certificates.crt "$room/system/etc/ssl/certs/ca-certificates.crt"
copy_tree
name=root uid=0 home=/root
[ -z "$user" ] || { name=forester uid=1000 home=/home/forester; }
chown -R "$uid:$uid" "$room/system/srv/studio"

mapfile -t network < <(env | grep -iE '^(https?_proxy|no_proxy|SSL_CERT_FILE|PIP_CERT|REQUESTS_CA_BUNDLE|CURL_CA_BUNDLE)=')
exec unshare --mount --pid --fork ${offline:+--net} bash -euc '
    root=$1 name=$2 home=$3 n=$4
    shift 4
    mount -t proc proc "$root/proc"
    mount -t tmpfs tmpfs "$root/dev/shm"
    mount -t devpts devpts "$root/dev/pts" 2>/dev/null || true
    settings=("${@:1:n}")
    shift "$n"
    exec chroot "$root" runuser -u "$name" -- env -i HOME="$home" PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
        LANG=C.UTF-8 CI=true "${settings[@]}" bash -c '\''cd /srv/studio && exec "$@"'\'' clean-room "$@" </dev/null
' clean-room "$room/system" "$name" "$home" "${#network[@]}" "${network[@]}" "$@"
