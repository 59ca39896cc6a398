#!/bin/sh
# In place of the entry point of PostgreSQL's image: copies the primary's data at the first start, then follows it.
# PRIMARY: how to connect to it, with the name that its synchronous_standby_names has.
set -e
if [ ! -d "$PGDATA" ]; then
    rm -rf "$PGDATA.part" # of a copy that was interrupted
    pg_basebackup -D "$PGDATA.part" -d "$PRIMARY" -R -X stream -c fast
    mv "$PGDATA.part" "$PGDATA"
fi
exec "$@"
