#!/usr/bin/env bash
# Installs the package into a Debian that has nothing else, uses it, upgrades, removes and purges it there.
# Needs root (chroot), debootstrap, and the mirror that this machine's apt uses; where it cannot, it says so and ends with 77.
# Usage: try_in_clean_root.sh PACKAGE.deb [FOLDER for the root]
set -euo pipefail

package=$(realpath "$1")
base=${2:-$(mktemp -d)}
root=$base/root
log=$(mktemp)

skip() { echo "deb-test SKIPPED, nothing was tried: $*" >&2; exit 77; }
fail() { echo "deb-test failed: $*" >&2; echo '--- last output:' >&2; tail -n 30 "$log" >&2; exit 1; }
say() { printf '%4d s  %s\n' "$SECONDS" "$*"; }
inside() { chroot "$root" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive LC_ALL=C "$@"; }
# Runs a command in there: expect CODE WORDS COMMAND...; WORDS must be in what it prints.
expect() {
    local code=0 wanted=$1 words=$2
    shift 2
    inside "$@" >"$log" 2>&1 </dev/null || code=$?
    [ "$code" = "$wanted" ] || fail "$* ended with $code in place of $wanted"
    [ -z "$words" ] || grep -q -e "$words" "$log" || fail "$* does not say '$words'"
}

[ "$(id -u)" = 0 ] || skip 'this needs root'
command -v debootstrap >/dev/null || skip 'no debootstrap here: sudo apt install debootstrap'
. /etc/os-release
mirror=$(apt-get indextargets --format '$(RELEASE) $(COMPONENT) $(REPO_URI)' 'Created-By: Packages' |
    awk -v release="${VERSION_CODENAME:-}" '$1 == release && $2 == "main" { print $3; exit }')
[ -n "$mirror" ] || skip "apt has no mirror of ${VERSION_CODENAME:-this system} main"

cleanup() {
    [ -z "${daemon:-}" ] || kill "$daemon" 2>/dev/null || true
    ! mountpoint -q "$root/proc" || umount "$root/proc"
    rm -rf --one-file-system "$root" "$log" "$log.daemon"
    rmdir "$base" 2>/dev/null || true
}
trap cleanup EXIT

say "a clean $PRETTY_NAME"
debootstrap --variant=minbase --include=systemd "$VERSION_CODENAME" "$root" "$mirror" >"$log" 2>&1 ||
    skip "debootstrap cannot make a root here: $(tail -n 1 "$log")"
# Where it may not be mounted, as in some containers, systemd cannot know the boot id that the unit hands over.
proc=yes
mountpoint -q "$root/proc" || mount -t proc proc "$root/proc" 2>/dev/null || proc=no
# How this machine's apt reaches its mirror.
cp /etc/apt/apt.conf.d/* "$root/etc/apt/apt.conf.d/" 2>/dev/null || true
cp "$package" "$root/companion.deb"
inside apt-get update -q >"$log" 2>&1 || fail 'apt-get update'

say 'over an installation by hand: refused'
mkdir -p "$root/opt/companion"
touch "$root/opt/companion/pyvenv.cfg"
expect 100 'is there already, from an installation by hand' apt-get install -q -y --no-install-recommends /companion.deb
rm -r "$root/opt/companion"

say 'install'
expect 0 'sudo companion setup' apt-get install -q -y --no-install-recommends /companion.deb
inside dpkg --verify companion >"$log" && [ ! -s "$log" ] || fail 'dpkg --verify finds changed files'
version=$(dpkg-deb -f "$package" Version)
expect 0 "^companion ${version%%-*}$" companion --version
expect 0 'calibrate' companion --help
expect 0 'ports\|no serial' companion ports
expect 0 'arming:set_aux_auth_passed' companion autopilot script
expect 2 'companion setup makes it' companion status
expect 2 'companion setup makes it' companion check
expect 1 'apt remove companion' companion service remove
expect 1 'systemctl enable --now companion' companion service install
expect 0 '' systemctl enable companion.service
expect 0 '' systemd-analyze verify --man=no /usr/lib/systemd/system/companion.service \
    /usr/lib/systemd/system/companion-setup.service
[ $proc = yes ] || sed -i '/COMPANION_BOOT_ID=%b, ignoring/d' "$log"
[ ! -s "$log" ] || fail 'systemd finds faults with the units'

say 'its first configuration, where nothing is connected'
expect 1 'no autopilot was heard.*nothing was written' companion setup --yes --udp 14999
expect 0 'Written: /etc/companion/companion.toml$' \
    companion setup --yes --udp 14999 --mavlink udpin:127.0.0.1:14550 --no-check
grep -q 'companion run ' "$log" || fail 'where no systemd runs the next step is another one'

expect 3 'start it with: companion run$' companion calibrate

say 'the daemon, as nobody and without a writable place of its own, as the service has it'
cat >"$root/etc/companion/companion.toml" <<'TOML'
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
[storage]
directory = "/tmp/companion"
[control]
socket = "/tmp/companion.sock"
TOML
before=$(find "$root/opt" | sort)
chroot "$root" setpriv --reuid=65534 --regid=65534 --clear-groups env -i /usr/bin/companion run >"$log" 2>&1 &
daemon=$!
for _ in $(seq 300); do
    grep -q '^.*ready: ' "$log" && break
    kill -0 "$daemon" 2>/dev/null || fail 'the daemon has ended'
    sleep 0.1
done
grep -q 'ready: ' "$log" || fail 'the daemon is not ready after 30 s'
cp "$log" "$log.daemon"
expect 0 'state' companion status --json
kill -TERM "$daemon"
wait "$daemon" || { cp "$log.daemon" "$log"; fail 'the daemon did not end in order'; }
daemon=
rm -f "$log.daemon"
[ "$before" = "$(find "$root/opt" | sort)" ] || fail 'the daemon left files in /opt'

say 'the same again, as an upgrade: the configuration stays'
mkdir -p "$root/var/lib/private/companion"
touch "$root/var/lib/private/companion/record"
sum=$(sha256sum <"$root/etc/companion/companion.toml")
expect 0 'companion' apt-get install -q -y --reinstall -o Dpkg::Options::=--force-confdef /companion.deb
[ "$sum" = "$(sha256sum <"$root/etc/companion/companion.toml")" ] || fail 'the upgrade has changed the configuration'

say 'remove: configuration and records stay'
expect 0 'Removing companion' apt-get remove -q -y companion
[ ! -e "$root/opt/companion" ] || fail "left behind: $(find "$root/opt/companion" | head -n 3)"
[ ! -e "$root/usr/bin/companion" ] || fail 'the command is still there'
[ -e "$root/etc/companion/companion.toml" ] && [ -e "$root/var/lib/private/companion/record" ] || fail 'too much removed'

say 'purge: nothing stays'
expect 0 'Purging' apt-get purge -q -y companion
# An empty /opt goes with the last package that had files in it.
mkdir -p "$root/opt"
left=$(find "$root/etc" "$root/opt" "$root/usr" "$root/var/lib" -path "$root/var/lib/apt" -prune -o -name '*companion*' -print)
[ -z "$left" ] || fail "left behind: $left"

say 'deb-test passed'
