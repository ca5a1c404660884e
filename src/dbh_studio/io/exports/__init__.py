"""The inventory in the formats it is handed in, all made of the one table, so that ids and numbers agree."""

from dbh_studio.io.exports.cloud_las import write_labelled_cloud
from dbh_studio.io.exports.columns import Column, Table, table_of
from dbh_studio.io.exports.drawing import write_dxf, write_svg
from dbh_studio.io.exports.edit_log import write_edits_csv
from dbh_studio.io.exports.geojson import write_geojson
from dbh_studio.io.exports.geopackage import write_geopackage
from dbh_studio.io.exports.report_html import report_html, write_report_html
from dbh_studio.io.exports.scene_html import write_scene_html
from dbh_studio.io.exports.spreadsheet import write_xlsx
from dbh_studio.io.exports.stem_profiles import profile_table, write_profiles_csv

__all__ = [
    "Column",
    "Table",
    "profile_table",
    "report_html",
    "table_of",
    "write_dxf",
    "write_edits_csv",
    "write_geojson",
    "write_geopackage",
    "write_labelled_cloud",
    "write_profiles_csv",
    "write_report_html",
    "write_scene_html",
    "write_svg",
    "write_xlsx",
]
