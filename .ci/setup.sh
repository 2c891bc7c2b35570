#!/usr/bin/env bash
# Makes .venv ready, then runs the given command in it:  .ci/setup.sh [command [argument...]]
#
# Nothing is written outside the checkout except the usual download caches of pip and uv. When neither
# pyproject.toml nor constraints.txt has changed since the last complete set-up, this costs milliseconds.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$PWD

venv=$root/.venv
stamp=$venv/.setup-complete     # what the last complete set-up was made from; written last
unfinished=$venv/.setup-started # present only while installing: if found at the start, that run was cut off
render=$venv/.setup-render      # which MuJoCo backend can draw without a screen: egl, osmesa or none

say() { printf 'setup: %s\n' "$*" >&2; }
stop() {
  say "$*"
  exit 1
}
wanted() { # the set-up is redone when any of this changes
  printf '%s\n' "$root"
  cat pyproject.toml constraints.txt
}
complete() {
  [ -f "$stamp" ] && [ ! -e "$unfinished" ] && wanted | cmp -s - "$stamp" && "$venv/bin/python" -c '' 2>/dev/null
}

suitable() { # a Python is tried by running it: a pyenv shim exists also where its version is not selected
  "$1" -c 'import sys, ssl, venv, ensurepip; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1
}
find_python() {
  local candidate versions=""
  if command -v pyenv >/dev/null; then
    versions=$(pyenv root 2>/dev/null || true)
  fi
  versions=${versions:-${PYENV_ROOT:-$HOME/.pyenv}}
  # 3.12 first, because most wheels exist for it; then the others, newest first.
  while IFS= read -r candidate; do
    if suitable "$candidate"; then
      printf '%s\n' "$candidate"
      return
    fi
  done < <(
    printf '%s\n' python3.12
    find "$versions/versions" -maxdepth 1 -name '3.12*' 2>/dev/null | sort -rV | sed 's|$|/bin/python|'
    printf '%s\n' python3.13 python3
    find "$versions/versions" -maxdepth 1 -name '3.1[3-9]*' 2>/dev/null | sort -rV | sed 's|$|/bin/python|'
  )
}

share_pip_settings() { # uv reads none of pip's settings: hand over the ones that say where packages come from
  local index extra
  index=${PIP_INDEX_URL:-$("$venv/bin/python" -m pip config get global.index-url 2>/dev/null || true)}
  extra=${PIP_EXTRA_INDEX_URL:-$("$venv/bin/python" -m pip config get global.extra-index-url 2>/dev/null || true)}
  if [ -n "$index" ] && [ -z "${UV_DEFAULT_INDEX:-}${UV_INDEX_URL:-}" ]; then
    export UV_DEFAULT_INDEX=$index
  fi
  if [ -n "$extra" ] && [ -z "${UV_INDEX:-}${UV_EXTRA_INDEX_URL:-}" ]; then
    export UV_EXTRA_INDEX_URL=$extra UV_INDEX_STRATEGY=${UV_INDEX_STRATEGY:-unsafe-best-match}
  fi
  if [ -n "${PIP_CERT:-}" ]; then
    export SSL_CERT_FILE=${SSL_CERT_FILE:-$PIP_CERT}
  fi
}

install_packages() {
  local quiet=(-q) python=$venv/bin/python
  if [ -t 2 ]; then quiet=(); fi
  if [ -x "$venv/bin/uv" ] || "$python" -m pip install -qq uv 2>/dev/null; then
    if (
      share_pip_settings
      "$venv/bin/uv" pip install ${quiet[@]+"${quiet[@]}"} --python "$python" -c constraints.txt -e '.[dev]'
    ); then
      return
    fi
    say "uv could not install the packages; trying pip, which is slower."
  else
    say "uv is not obtainable here; using pip, which is slower."
  fi
  "$python" -m pip install ${quiet[@]+"${quiet[@]}"} -c constraints.txt -e '.[dev]' ||
    stop "the packages could not be installed (see above): check the network and free disk space (about 8 GB), then run the same command again."
}

compile_once() { # where Python may not keep bytecode, every start would compile torch and LeRobot again (10 s)
  if [ -n "${PYTHONDONTWRITEBYTECODE:-}" ]; then
    PYTHONDONTWRITEBYTECODE='' "$venv/bin/python" -c 'import matplotlib.pyplot, mujoco, pytest, lerobot.scripts.lerobot_eval' \
      >/dev/null 2>&1 || true
  fi
}

set_up() {
  if [ -e "$unfinished" ]; then
    say "an earlier set-up was cut off; starting .venv again."
    rm -rf "$venv"
  elif [ -f "$stamp" ] && [ "$(head -n 1 "$stamp")" != "$root" ]; then
    say "the checkout was moved; starting .venv again."
    rm -rf "$venv"
  fi
  if ! { suitable "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }; then
    local python=${PYTHON:-}
    if [ -z "$python" ]; then
      python=$(find_python)
    elif ! suitable "$python"; then
      stop "PYTHON=$python is not a working Python >= 3.12 with the venv module: name another, or none to have one looked for."
    fi
    [ -n "$python" ] || stop "Python 3.12 or newer with the venv module is missing: install it (for example 'sudo apt install python3.12-venv' or 'pyenv install 3.12') or name one with PYTHON=/path/to/python."
    say "making .venv with $("$python" --version)"
    "$python" -m venv --clear "$venv" || stop "'$python -m venv .venv' failed: check free disk space and rights in this folder."
  fi
  rm -f "$stamp" "$render"
  touch "$unfinished"
  say "installing into .venv (the first time some minutes: downloads of 3 GB, 8 GB on disk)"
  install_packages
  compile_once
  rm -f "$unfinished"
  wanted >"$stamp"
  say "ready"
}

can_draw() {
  MUJOCO_GL=$1 "$venv/bin/python" -c 'import mujoco; mujoco.GLContext(16, 16).make_current()' >/dev/null 2>&1
}
choose_renderer() { # only Linux without a screen needs a choice, and only camera observations need drawing
  if [ "$(uname -s)" != Linux ] || [ -n "${MUJOCO_GL:-}" ] || [ -n "${DISPLAY:-}" ]; then
    return
  fi
  local found backend
  found=$(cat "$render" 2>/dev/null || echo none)
  if [ "$found" = none ]; then
    for backend in egl osmesa; do
      if can_draw "$backend"; then
        found=$backend
        break
      fi
    done
    printf '%s\n' "$found" >"$render"
  fi
  if [ "$found" = none ]; then
    say "cameras cannot be drawn without a screen because libEGL is missing ('sudo apt install libegl1 libegl-mesa0'); everything without cameras works."
    found=egl
  fi
  export MUJOCO_GL=$found
}

if ! complete; then
  # Two of us at once take turns; the lock is on a file that is there anyway, so nothing is left behind.
  exec 9<pyproject.toml
  if command -v flock >/dev/null; then flock 9; fi
  complete || set_up
  exec 9<&-
fi
if [ $# -gt 0 ]; then
  choose_renderer
  export PATH=$venv/bin:$PATH VIRTUAL_ENV=$venv
  exec "$@"
fi
