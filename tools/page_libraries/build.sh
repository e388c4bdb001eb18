#!/bin/sh
# Makes slam/evaluation/templates/vendor anew: the libraries that ship inside the pages, of the versions in
# package-lock.json, cut to what the pages use. Needs node and npm; the product needs neither.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
vendor=$here/../../slam/evaluation/templates/vendor
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp "$here"/package*.json "$here"/*.js "$work"
cd "$work"
npm ci --silent --no-audit --no-fund
for name in ol three; do
  npx esbuild "$name.js" --bundle --minify --format=iife --target=es2022 --charset=ascii \
    --legal-comments=none --log-level=warning --outfile="$name.min.js"
done
headed() { # file, libraries: their licences first
  file=$1; shift
  { for library in "$@"; do
      printf '/*! %s %s\n' "$library" "$(node -p "require('./node_modules/$library/package.json').version")"
      sed 's/^/ * /; s/ *$//' "node_modules/$library"/LICENSE*
      printf ' */\n'
    done
    cat "$file"; } > "$vendor/$file"
}
headed ol.min.js ol rbush quickselect
headed three.min.js three
cp node_modules/uplot/dist/uPlot.iife.min.js uplot.min.js
headed uplot.min.js uplot
cp node_modules/uplot/dist/uPlot.min.css "$vendor/uplot.min.css"
npx esbuild node_modules/ol/ol.css --minify --log-level=warning --outfile="$vendor/ol.min.css"
