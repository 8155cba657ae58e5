"""Tables that people have: text as instruments and spreadsheets write it, Parquet, netCDF."""
