#!/usr/bin/env bash
# Install the system libraries, and for the tests the browser and a font, that the doctor finds missing.
#
#   tools/system_packages.sh PYTHON run|test [STAMP]
#
# Does nothing, and needs no network, when nothing is missing. Without the right to install it prints the line to run and
# goes on: the studio works without these parts. STAMP is touched once nothing is missing any more.
set -euo pipefail

python=$1 kind=$2 stamp=${3:-}

missing() { "$python" -m dbh_studio.app.doctor --apt-packages "$kind" | tr '\n' ' ' | sed 's/ $//'; }

install() {
    if [ "$(id -u)" -eq 0 ]; then as_root=(); else as_root=(sudo -n); fi
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get update -qq &&
        "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"
}

may_install() {
    command -v apt-get >/dev/null && { [ "$(id -u)" -eq 0 ] || { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }; }
}

packages=$(missing)
# A library that is missing can hide another one, so the question is asked again after each answer.
for _ in 1 2 3; do
    [ -n "$packages" ] && may_install || break
    echo "Installing system packages: $packages"
    # shellcheck disable=SC2086  # a list of names
    install $packages </dev/null >/dev/null || { echo "apt-get failed; its message is above." >&2; break; }
    before=$packages
    packages=$(missing)
    [ "$packages" != "$before" ] || break
done

if [ -n "$packages" ]; then
    sudo=$([ "$(id -u)" -eq 0 ] || echo "sudo ")
    {
        echo "Some system packages are missing, and set-up may not install them here. To have all parts of the studio, run:"
        echo
        echo "    ${sudo}apt-get update && ${sudo}apt-get install -y --no-install-recommends $packages"
        echo
        echo "Set-up goes on without them; 'dbh-studio doctor' says what each one is for."
    } >&2
elif [ -n "$stamp" ]; then
    touch "$stamp"
fi
