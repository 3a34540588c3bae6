// One library for each stage, as PDAL's loader wants: it loads libpdal_plugin_filter_NAME for filters.NAME, and calls this.
// PDAL_STAGES_TYPE is the stage's type; all else is in stage.cpp, which is compiled once.

namespace pdal_stages
{

void registerStage(const char *type);

} // namespace pdal_stages

#ifdef _WIN32
#define PDAL_STAGES_VISIBLE __declspec(dllexport)
#else
#define PDAL_STAGES_VISIBLE __attribute__((visibility("default")))
#endif

extern "C" PDAL_STAGES_VISIBLE void PF_initPlugin()
{
    pdal_stages::registerStage(PDAL_STAGES_TYPE);
}
