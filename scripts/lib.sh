# shellcheck shell=bash disable=SC2034
# Shared by the scripts beside it: messages, timed steps with a log, Debian packages, the choice of Python.
# Sourced, never run. Sets ROOT (the checkout), SCRIPTS and LOG.

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
SCRIPTS=$ROOT/scripts
STATE=$ROOT/.setup # log, lock; nothing here is needed once set up
LOG=$STATE/log

# ---- messages --------------------------------------------------------------------------------------------

say() { printf '%s\n' "$*"; }

# die WHAT [CURE...]: one line on what is wrong, then what to do about it
die() {
  printf '\nerror: %s\n' "$1" >&2
  shift
  [ $# = 0 ] || printf '       %s\n' "$@" >&2
  exit 1
}

# step WHAT COMMAND...: run it, its output into the log, and print how long it took. Never call this inside a
# condition: bash would then ignore failures within a function given as the command.
step() {
  local what=$1 start=$SECONDS rc errexit=$-
  shift
  printf '  %-64s ' "$what"
  printf '\n### %s  %s\n' "$(date '+%H:%M:%S')" "$what" >>"$LOG"
  set +e
  (
    set -e
    "$@"
  ) >>"$LOG" 2>&1 </dev/null
  rc=$?
  case $errexit in *e*) set -e ;; esac
  if [ $rc = 0 ]; then
    printf '%4d s\n' $((SECONDS - start))
    return 0
  fi
  printf 'FAILED after %d s\n' $((SECONDS - start))
  if [ $rc = 130 ] || [ $rc = 143 ]; then exit $rc; fi
  explain "$what"
}

# explain WHAT: read the failed step's part of the log and say in words what it means
explain() {
  local part
  part=$(awk '/^### / { part = "" } { part = part $0 "\n" } END { printf "%s", part }' "$LOG")
  printf '\nThe end of its output (all of it: %s):\n' "$LOG" >&2
  printf '%s\n' "$part" | tail -n 12 | sed 's/^/  | /' >&2
  has() { grep -qiE "$1" <<<"$part"; }
  if has 'No space left on device|disk quota exceeded'; then
    die "$1: the disk is full" "$(df -Ph "$ROOT" "${TMPDIR:-/tmp}" | awk 'NR > 1 { print $6 ": " $4 " free" }' | paste -sd' ')" \
      "Free some space (TMPDIR chooses another place for temporary files) and run this again."
  elif has 'Read-only file system|Permission denied|not writeable|not writable'; then
    die "$1: no permission to write" "The checkout and ${TMPDIR:-/tmp} must be writable for $(id -un)."
  elif has 'Could not get lock|Unable to acquire the dpkg|dpkg was interrupted'; then
    die "$1: another package manager is at work, or was interrupted" \
      "Wait for it to end (or run: dpkg --configure -a), then run this again."
  elif has 'DO NOT MATCH THE HASHES|Hash Sum mismatch'; then
    die "$1: a download is not the file that was expected" \
      "A mirror or proxy gave something else; run this again, or use another mirror."
  elif has 'certificate verify failed|CERTIFICATE_VERIFY_FAILED'; then
    die "$1: a server's certificate is not trusted here" \
      "Behind a company's proxy, put its certificate where apt and pip look: /usr/local/share/ca-certificates" \
      "(then update-ca-certificates) and PIP_CERT=/etc/ssl/certs/ca-certificates.crt."
  elif has 'Temporary failure|Could not resolve|Could not connect|Failed to establish a new connection|Network is unreachable|Connection (refused|timed out|reset)|Read timed out|Max retries'; then
    die "$1: the network, or a server on it, does not answer" \
      "apt uses the mirrors of /etc/apt, pip those of 'pip config list'; both honour http_proxy and https_proxy." \
      "Check these and run this again: what is done is kept."
  elif has 'No matching distribution found|Could not find a version'; then
    die "$1: pip's index has no package that fits $(grep -oiE 'for [A-Za-z0-9_.-]+([<>=!~]=?[^ )]*)?' <<<"$part" | tail -n 1)" \
      "This is Python ${PY_VERSION:-?} on $(uname -m); Linux on x86_64 with Python 3.11 to 3.13 surely has all packages." \
      "PYTHON=/path/to/python3 chooses another interpreter."
  elif has 'Unable to locate package|has no installation candidate|does not have a Release file|404 +Not Found'; then
    die "$1: apt's sources lack a package" "See the lines above and /etc/apt/sources.list*; then run: apt-get update"
  elif has 'Python\.h: No such file|Could NOT find Python3'; then
    die "$1: Python's headers are missing" "Debian, Ubuntu: apt-get install python3-dev. Fedora: dnf install python3-devel."
  elif has 'No CMAKE_CXX_COMPILER|g\+\+: not found|c\+\+: not found'; then
    die "$1: no C++ compiler" "Debian, Ubuntu: apt-get install g++. Fedora: dnf install gcc-c++."
  elif has 'Killed signal|out of memory|Cannot allocate memory'; then
    die "$1: out of memory" "CMAKE_BUILD_PARALLEL_LEVEL=1 needs less: about 1 GB."
  fi
  die "$1 failed; see the output above and $LOG"
}

# ---- Debian packages -------------------------------------------------------------------------------------

have_apt() { command -v apt-get >/dev/null && command -v dpkg-query >/dev/null; }

installed() { [ "$(dpkg-query -W -f='${db:Status-Status}' "$1" 2>/dev/null)" = installed ]; }

# apt_root COMMAND...: run it as root, or fail
apt_root() {
  if [ "$(id -u)" = 0 ]; then
    DEBIAN_FRONTEND=noninteractive "$@"
  else
    sudo -n DEBIAN_FRONTEND=noninteractive "$@"
  fi
}

# may_install: whether apt-get can be run as root from here
may_install() {
  [ "$(id -u)" = 0 ] && return 0
  command -v sudo >/dev/null || return 1
  sudo -n true 2>/dev/null && return 0
  [ -t 0 ] && [ -t 1 ] && sudo -p 'sudo password for %u, to install Debian packages: ' true
}

BUNDLE=/etc/ssl/certs/ca-certificates.crt
LATER="libgfortran5" # not in a minimal Debian, and not needed by the packages above

# packages WHY NAME...: install those of the Debian packages that are missing
packages() {
  local why=$1 name missing=()
  shift
  for name; do installed "$name" || missing+=("$name"); done
  [ ${#missing[@]} = 0 ] && return 0
  if ! may_install; then
    # What later steps will ask for as well, so that root is needed once
    for name in python3 python3-venv python3-dev g++ patchelf $LATER; do
      installed "$name" || [[ " ${missing[*]} " == *" $name "* ]] || missing+=("$name")
    done
    die "$why needs Debian packages that only root can install. Run this as root, once, then this script again:" \
      "apt-get update && apt-get install -y --no-install-recommends ${missing[*]}"
  fi
  refresh_apt
  installed ca-certificates || cp "$BUNDLE" "$STATE/trusted.crt" 2>/dev/null || true
  step "apt: ${missing[*]:0:4}$([ ${#missing[@]} -le 4 ] || echo " and $((${#missing[@]} - 4)) more")" \
    apt_root apt-get -q -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3 install -y --no-install-recommends "${missing[@]}"
  keep_trust
}

# keep_trust: where a list of certificates was put there by hand, as in containers behind a proxy, installing
# Debian's package ca-certificates replaces it. Let pip go on with the one it had.
keep_trust() {
  if [ -e "$STATE/trusted.crt" ] && ! cmp -s "$BUNDLE" "$STATE/trusted.crt" && [ "${PIP_CERT:-$BUNDLE}" = "$BUNDLE" ]; then
    export PIP_CERT=$STATE/trusted.crt
  fi
}

# refresh_apt: once per run. A third party's broken source must not stop us: whether the packages are found decides.
refresh_apt() {
  [ -z "${APT_FRESH:-}" ] || return 0
  export APT_FRESH=1
  step "apt: refresh the package lists" tolerate apt_root apt-get -q -o Acquire::Retries=3 update
}

tolerate() { "$@" || echo "(exit status $?, going on)"; }

# candidate NAME: the version apt would install, nothing where there is none
candidate() { LC_ALL=C apt-cache policy "$1" 2>/dev/null | awk '$1 == "Candidate:" && $2 != "(none)" { print $2 }'; }

# ---- Python ----------------------------------------------------------------------------------------------

python_version() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

python_fits() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (4,))' 2>/dev/null; }

# pythons: interpreters worth a look, best first: $PYTHON alone where it is set; else the active conda or virtual
# environment, then PATH. Never this checkout's own .venv.
pythons() {
  local name found
  if [ -n "${PYTHON:-}" ]; then
    command -v "$PYTHON" || die "PYTHON=$PYTHON: no such program"
    return
  fi
  for name in "${CONDA_PREFIX:+$CONDA_PREFIX/bin/python}" "${VIRTUAL_ENV:+$VIRTUAL_ENV/bin/python}" \
    python3 python python3.13 python3.12 python3.11 python3.14 python3.10; do
    if [ -z "$name" ] || ! found=$(command -v "$name"); then continue; fi
    case $found in "$ROOT"/.venv/*) ;; *) printf '%s\n' "$found" ;; esac
  done | awk '!seen[$0]++'
}

# shquote TEXT: TEXT in single quotes, for a shell script we write
shquote() { printf "'%s'" "${1//\'/\'\\\'\'}"; }

# write_wrapper VENV PROGRAM PLUGIN_FOLDERS: VENV/bin/pdal. An embedded Python finds its packages through the
# python3 that comes first on PATH, so that must be VENV's.
write_wrapper() {
  rm -f "$1/bin/pdal"
  cat >"$1/bin/pdal" <<WRAPPER
#!/bin/sh
# PDAL whose filters.python runs this environment's Python. Written by scripts/setup.
PATH=$(shquote "$1/bin"):"\$PATH"
PDAL_DRIVER_PATH=\${PDAL_DRIVER_PATH:-$(shquote "$3")}
export PATH PDAL_DRIVER_PATH
exec $(shquote "$2") "\$@"
WRAPPER
  chmod +x "$1/bin/pdal"
}
