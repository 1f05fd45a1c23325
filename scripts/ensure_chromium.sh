#!/usr/bin/env bash
# The tests of the report open it in headless Chromium, and skip where there is none: install it
# where apt can, and go on without it where not.
set -uo pipefail
command -v chromium >/dev/null || command -v chromium-browser >/dev/null && exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "no Chromium: the tests that open reports are skipped (apt-get install chromium)"
    exit 0
fi
echo "installing Chromium for the tests that open reports ..."
{ apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
    chromium fonts-dejavu-core; } >/dev/null 2>&1 \
    || echo "apt-get could not install Chromium: the tests that open reports are skipped"
