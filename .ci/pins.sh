#!/usr/bin/env bash
# Writes constraints.txt anew (make pins): the newest versions that pyproject.toml with all extras allows.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

pins=$(mktemp)
trap 'rm -f "$pins"' EXIT
{
  echo "# Exact versions that the tests ran with; a package that a platform does not need is simply not installed."
  echo "# Refresh with 'make pins', then 'make check test slow'."
  .venv/bin/uv pip compile -q pyproject.toml --all-extras --python .venv/bin/python \
    --no-header --no-annotate --no-emit-index-url --no-emit-find-links "$@"
} >"$pins"
cat "$pins" >constraints.txt
