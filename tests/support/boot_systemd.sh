#!/bin/bash
# Boots systemd as process 1 of namespaces of its own, on a copy of this machine's root that forgets what is written.
# Started by booted_systemd.py with: unshare --mount --pid --cgroup --uts --ipc --fork --kill-child
#   $1 an empty folder, $2 the project, $3 Python's prefix, $4 its site-packages
set -eu
mount --make-rprivate /
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
root=$1/root
mount --rbind /dev "$root/dev"
mount -t proc proc "$root/proc"
# What systemd would set on the machine as a whole is not ours to set.
mount --bind "$root/proc/sys" "$root/proc/sys"
mount -o remount,ro,bind "$root/proc/sys"
mount -t sysfs -o ro sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
mount -t tmpfs tmpfs "$root/run"
mount -t tmpfs tmpfs "$root/tmp"
mount -t tmpfs tmpfs "$root/var/tmp"
rm -rf "$root/etc/systemd/system" "$root/var/log/journal" "$root/var/lib/companion" "$root/var/lib/private/companion"
mkdir -p "$root/etc/systemd/system" "$root/run/log/journal"
# Python where the service may look, and the companion as an installation would have it.
mkdir -p "$root/opt/companion/bin" "$root/opt/companion/python" "$root/opt/companion/site" "$root/opt/companion/src"
mount --bind "$3" "$root/opt/companion/python"
mount --bind "$4" "$root/opt/companion/site"
cp -r "$2/companion" "$2/systemd" "$root/opt/companion/src"
chmod -R a+rX "$root/opt/companion/src"
ln -s ../python/bin/python3 "$root/opt/companion/bin/python3"
cat >"$root/opt/companion/bin/companion" <<'END'
#!/bin/sh
# This Python's own library, not the machine's of the same name, with which its modules need not fit.
LD_LIBRARY_PATH=/opt/companion/python/lib PYTHONPATH=/opt/companion/src:/opt/companion/site PYTHONDONTWRITEBYTECODE=1 \
    exec /opt/companion/bin/python3 -m companion "$@"
END
chmod a+rx "$root/opt/companion/bin/companion"
cat >"$root/etc/systemd/system/booted.target" <<'END'
[Unit]
Wants=systemd-journald.service
After=systemd-journald.service
END
mkdir "$root/old"
cd "$root"
pivot_root . old
umount -l /old
exec env -i container=other PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    /lib/systemd/systemd --system --unit=booted.target --log-target=journal
