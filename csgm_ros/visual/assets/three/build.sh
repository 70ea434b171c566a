#!/usr/bin/env bash
# Remakes three.min.js and LICENSE from the npm packages that package-lock.json names; needs node and npm.
set -euo pipefail
cd "$(dirname "$0")"
npm ci --ignore-scripts --no-audit --no-fund
version=$(node -p 'JSON.parse(fs.readFileSync("node_modules/three/package.json")).version')
npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none \
  --banner:js="/* three.js $version, MIT license, https://threejs.org/license; see LICENSE beside this file */" \
  --outfile=three.min.js
cp node_modules/three/LICENSE LICENSE
rm -rf node_modules
